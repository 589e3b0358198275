// Takes a robot out of service, so that nobody sends it, or puts it back.
import { useState } from "preact/hooks";
import { request, robotPath } from "../api/client";
import type { OutOfService, ServiceBody } from "../api/types";
import { useConsole, useShown } from "../context";
import { t } from "../i18n/i18n";
import { sentence } from "../stop";
import { duration } from "../text";
import { outOfService } from "../why";

/** For how long (s); 0: until somebody puts it back. */
const TIMES = [0, 3600, 8 * 3600, 24 * 3600] as const;
const REASON_MAX = 120;

interface Props {
  readonly id: string;
  readonly out: OutOfService | null;
  readonly onClose: () => void;
}

export function ServicePanel({ id, out, onClose }: Props): preact.JSX.Element {
  const { say } = useConsole();
  const [reason, setReason] = useState("");
  const [seconds, setSeconds] = useState<number>(0);
  const [problem, setProblem] = useState("");
  const [waiting, setWaiting] = useState(false);
  // What the button does is fixed when the panel opens: another operator may do the same just before it is pressed.
  const [putsBack] = useState(out !== null);
  const isOvertaken = !waiting && putsBack !== (out !== null);

  const send = async (event: Event): Promise<void> => {
    event.preventDefault();
    if (isOvertaken || waiting) return;
    setProblem("");
    setWaiting(true);
    const path = robotPath(id, "out-of-service");
    const body: ServiceBody = { reason: reason.trim(), ...(seconds > 0 ? { ttl_s: seconds } : {}) };
    try {
      await (putsBack ? request("DELETE", path) : request<OutOfService>("PUT", path, { body }));
      say(t(putsBack ? "service.isIn" : "service.isOut", { robot: id }));
      onClose();
    } catch (error) {
      setWaiting(false);
      setProblem(sentence(error));
      say(t("service.failed", { robot: id, reason: sentence(error) }), "failed");
    }
  };
  return (
    <form ref={useShown()} class="card" aria-label={t("service.title", { robot: id })} onSubmit={(event) => void send(event)}>
      <h3>{t("service.title", { robot: id })}</h3>
      {putsBack ? out && <p>{outOfService(out)}</p> : (
        <>
          <p class="muted">{t("service.help")}</p>
          <label class="field">{t("field.reason")}
            <input dir="auto" maxLength={REASON_MAX} required value={reason} onInput={(event) => setReason(event.currentTarget.value)} />
          </label>
          <div class="choices" role="group" aria-label={t("service.time")}>
            {TIMES.map((time) => (
              <button key={time} type="button" aria-pressed={time === seconds} onClick={() => setSeconds(time)}>
                {time === 0 ? t("service.forever") : duration(time)}
              </button>
            ))}
          </div>
        </>
      )}
      <p class="problem" role="alert">{isOvertaken ? t("service.overtaken", { now: out ? outOfService(out) : t("service.isIn", { robot: id }) }) : problem}</p>
      <div class="actions">
        <button class="primary" disabled={waiting || isOvertaken || (!putsBack && reason.trim() === "")}>{t(putsBack ? "service.in" : "command.disable")}</button>
        <button type="button" onClick={onClose}>{t("cancel")}</button>
      </div>
    </form>
  );
}

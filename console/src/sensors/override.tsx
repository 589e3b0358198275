// What an operator says of an area instead of its sensors, for a time.
import { useState } from "preact/hooks";
import { request } from "../api/client";
import type { AreaView, OverrideBody } from "../api/types";
import { useConsole } from "../context";
import { t } from "../i18n/i18n";
import { sentence } from "../stop";
import { duration } from "../text";

const TIMES = [5 * 60, 15 * 60, 3600, 8 * 3600, 24 * 3600] as const;
const CLEAR_MAX_S = 15 * 60;
const REASON_MAX = 200;

export function Override({ area }: { readonly area: AreaView }): preact.JSX.Element {
  const { say, session } = useConsole();
  const [state, setState] = useState<OverrideBody["state"]>("blocked");
  const [seconds, setSeconds] = useState<number>(TIMES[1]);
  const [reason, setReason] = useState("");
  const [problem, setProblem] = useState("");
  const { id } = area.definition;
  const path = `areas/${encodeURIComponent(id)}/override`;
  const condition: Record<string, string> = area.override ? { "If-Match": `"${area.override.version}"` } : {};
  const times = TIMES.filter((time) => state === "blocked" || time <= CLEAR_MAX_S);

  const send = async (what: Promise<unknown>, done: string): Promise<void> => {
    setProblem("");
    try {
      await what;
      say(done);
      setReason("");
    } catch (error) {
      setProblem(sentence(error));
      say(t("sensors.failed", { area: id, reason: sentence(error) }), "failed");
    }
  };
  const put = (): void => {
    const body: OverrideBody = { state, reason: reason.trim(), ttl_s: seconds };
    void send(request("PUT", path, { body, headers: condition }), t("sensors.overridden", { area: id, state: t(`state.${state}`) }));
  };
  return (
    <fieldset>
      <legend>{t("sensors.override")}</legend>
      {area.override && (
        <p>
          {t("sensors.overriddenBy", { who: area.override.author, state: t(`state.${area.override.state}`), rest: duration(area.override.rest_s) })}{" "}
          <bdi>{area.override.reason}</bdi>{" "}
          <button onClick={() => void send(request("DELETE", path, { headers: condition }), t("sensors.cleared", { area: id }))}>{t("sensors.clear")}</button>
        </p>
      )}
      <div class="choices" role="group" aria-label={t("sensors.override")}>
        <button aria-pressed={state === "blocked"} onClick={() => setState("blocked")}>{t("state.blocked")}</button>
        {session.role === "admin" && (
          <button aria-pressed={state === "clear"} onClick={() => {
            setState("clear");
            setSeconds(Math.min(seconds, CLEAR_MAX_S));
          }}>{t("state.clear")}</button>
        )}
      </div>
      <div class="choices" role="group" aria-label={t("sensors.time")}>
        {times.map((time) => <button key={time} aria-pressed={time === seconds} onClick={() => setSeconds(time)}>{duration(time)}</button>)}
      </div>
      <label class="field">{t("field.reason")}
        <input dir="auto" maxLength={REASON_MAX} required value={reason} onInput={(event) => setReason(event.currentTarget.value)} />
      </label>
      <p class="problem" role="alert">{problem}</p>
      <button class="primary" disabled={reason.trim() === ""} onClick={put}>{t("sensors.set")}</button>
    </fieldset>
  );
}

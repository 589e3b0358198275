// Places, and who may choose them: what is public is for visitors, too; and the visits that are under way.
import { useEffect, useState } from "preact/hooks";
import { request } from "../api/client";
import type { OpenVisit, Place } from "../api/types";
import { mayOperate, useConsole, useLive } from "../context";
import { t } from "../i18n/i18n";
import { sentence } from "../stop";
import { duration } from "../text";

export function Places(): preact.JSX.Element {
  const { floor, session, say } = useConsole();
  const live = useLive(["place"]);
  const [changing, setChanging] = useState("");
  const places = [...live.of.place].sort(([a, { label: one }], [b, { label: other }]) => (one || a).localeCompare(other || b));

  const open = async (id: string, name: string, to: boolean): Promise<void> => {
    const path = `places/${encodeURIComponent(id)}`;
    setChanging(id);
    try {
      const { etag } = await request<Place>("GET", path);
      await request<Place>("PATCH", path, { body: { public: to }, headers: etag === null ? {} : { "If-Match": etag } });
      say(t(to ? "places.opened" : "places.closed", { place: name }), "done", () => live.of.place.get(id)?.public === to);
    } catch (error) {
      say(t("places.failed", { place: name, reason: sentence(error) }), "failed");
    } finally {
      setChanging("");
    }
  };
  return (
    <section aria-labelledby="places-title">
      <h2 id="places-title">{t("places.title")}</h2>
      {places.length === 0 && <p class="muted">{t("map.none")}</p>}
      <ul class="rows">
        {places.map(([id, { label, x, y, public: shown }]) => (
          <li key={id} class="row">
            <bdi>{label || id}</bdi>
            {mayOperate(session) ? (
              <label class="value">
                <input type="checkbox" checked={shown} disabled={changing === id} onChange={() => void open(id, label || id, !shown)} />{" "}
                {t("places.public")}<span class="unseen">: {label || id}</span>
              </label>
            ) : <span class="value">{shown ? t("places.public") : ""}</span>}
            <button aria-label={t("places.showOf", { place: label || id })} onClick={() => floor?.show([[x, y]])}>{t("zones.show")}</button>
          </li>
        ))}
      </ul>
      {mayOperate(session) && <p><a class="button" href="#/codes">{t("codes.title")}</a></p>}
    </section>
  );
}

const PERIOD_MS = 3_000;

/** The visits that are not over; nothing without any. */
export function Visits(): preact.JSX.Element | null {
  const { live, session, say } = useConsole();
  const [visits, setVisits] = useState<readonly OpenVisit[]>([]);
  const operates = mayOperate(session);
  // Asked for again while one looks: the stream tells no role below the operators' of visitors.
  const look = (): Promise<void> => request<OpenVisit[]>("GET", "visits").then(({ value }) => setVisits(value), () => setVisits([]));
  useEffect(() => {
    if (!operates) return undefined;
    void look();
    const timer = setInterval(() => void look(), PERIOD_MS);
    return () => clearInterval(timer);
  }, [operates]);
  if (visits.length === 0) return null;

  const name = (id: string): string => live.of.place.get(id)?.label || id;
  const end = async ({ id, goal }: OpenVisit): Promise<void> => {
    try {
      await request("DELETE", `visits/open/${id}`);
      say(t("visits.over", { place: name(goal) }));
    } catch (error) {
      say(t("visits.failed", { reason: sentence(error) }), "failed");
    }
    await look();
  };
  return (
    <section aria-labelledby="visits-title">
      <h2 id="visits-title">{t("visits.title")}</h2>
      <ul class="rows">
        {visits.map((visit) => (
          <li key={visit.id} class="row">
            <span><bdi>{name(visit.start)}</bdi> → <bdi>{name(visit.goal)}</bdi></span>
            <span class="value">
              {t(`visits.${visit.state}`, { robot: visit.robot ?? "" })}{visit.seconds !== null && ` · ${duration(visit.seconds)}`}
              {" · "}<bdi>{visit.name}</bdi>
            </span>
            <button class="danger" aria-label={t("visits.endOf", { place: name(visit.goal) })} onClick={() => void end(visit)}>{t("visit.cancel")}</button>
          </li>
        ))}
      </ul>
    </section>
  );
}

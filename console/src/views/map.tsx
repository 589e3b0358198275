// What is going on, in words: the same that the map shows.
import { useConsole, useLive } from "../context";
import { said } from "../i18n/codes";
import { t } from "../i18n/i18n";
import { MapChange } from "../map/change";
import { routeHash } from "../router";
import { areaText, shownState } from "../sensors/words";
import { clockTime } from "../text";
import { Places, Visits } from "./places";
import { RobotCard } from "./robot-card";

const RANK = { blocked: 0, unknown: 1, clear: 2 } as const;

export function MapView(): preact.JSX.Element {
  const { robot, robots, session } = useConsole();
  const live = useLive(["zone", "area", "alert"]);
  const areas = [...live.of.area.values()].sort(
    (a, b) => RANK[shownState(a)] - RANK[shownState(b)]
      || (a.definition.label || a.definition.id).localeCompare(b.definition.label || b.definition.id),
  );
  const zones = [...live.of.zone.values()].filter((zone) => zone.active);
  const alerts = [...live.of.alert.values()];
  return (
    <>
      <h2>{t("view.robots")}</h2>
      {robots.length === 0 && <p class="muted">{t("robots.none")}</p>}
      <ul class="cards">
        {robots.map((id) => <li key={id}><RobotCard id={id} chosen={id === robot} /></li>)}
      </ul>
      <Visits />
      {alerts.length > 0 && (
        <>
          <h2>{t("map.alerts")}</h2>
          <ul class="rows">
            {alerts.map((alert) => (
              <li key={alert.id} class="row alert"><b>{alert.area}</b> {said(alert.code, alert.reason)} <span class="muted">{t("since", { time: clockTime(alert.since) })}</span></li>
            ))}
          </ul>
        </>
      )}
      <h2>{t("map.hazards")}</h2>
      <ul class="rows">
        {areas.map((area) => (
          <li key={area.definition.id} class="row">
            <span class={`swatch ${shownState(area)}`} aria-hidden="true" />
            <span><bdi>{area.definition.label || area.definition.id}</bdi></span>
            <span class="value">{areaText(area)}</span>
          </li>
        ))}
      </ul>
      <h2>{t("map.zones")}</h2>
      {zones.length === 0 && <p class="muted">{t("map.none")}</p>}
      <ul class="rows">
        {zones.map((zone) => (
          <li key={zone.id} class="row">
            <span class={`swatch zone ${zone.kind.toLowerCase()}`} aria-hidden="true" />
            <a href={routeHash("zones", zone.id)}><bdi>{zone.id}</bdi></a>
            <span class="value">{t(`zone.${zone.kind}`)} <bdi>{zone.reason}</bdi></span>
          </li>
        ))}
      </ul>
      <Places />
      {session.role === "admin" && <MapChange />}
    </>
  );
}

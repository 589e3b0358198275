// The robots, and all that can be done with the chosen one.
import { useConsole, useLive } from "../context";
import { t } from "../i18n/i18n";
import { RobotCard } from "./robot-card";

export function RobotsView(): preact.JSX.Element {
  const { robot } = useConsole();
  const live = useLive(["robot"]);
  const robots = [...live.of.robot.keys()].sort();
  return (
    <>
      <h2>{t("view.robots")}</h2>
      {robots.length === 0 && <p class="muted">{t("robots.none")}</p>}
      <ul class="cards">{robots.map((id) => <li key={id}><RobotCard id={id} chosen={id === robot} /></li>)}</ul>
    </>
  );
}

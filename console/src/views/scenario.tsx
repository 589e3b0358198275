// What a demo does, and what it costs.
import { useConsole } from "../context";
import { t } from "../i18n/i18n";
import { decimal, metres } from "../text";

export function ScenarioView(): preact.JSX.Element {
  const { scenario } = useConsole();
  if (!scenario) return <p class="muted">{t("connection.loading")}</p>;
  const { outcome, stages, processes, events } = scenario;
  const longest = Math.max(1, ...Object.values(stages));
  return (
    <>
      <h2>{t("view.scenario")}</h2>
      <p class="lead" role="status">{outcome ? outcome.join(": ") : scenario.phase}</p>
      <dl class="facts">
        <dt>{t("scenario.driven")}</dt><dd>{metres(scenario.distance)}</dd>
        <dt>{t("scenario.clearance")}</dt><dd>{metres(scenario.clearance, 2)}</dd>
        <dt>{t("scenario.speed")}</dt><dd>{decimal(scenario.speed, 1)}</dd>
        <dt>{t("scenario.seed")}</dt><dd>{scenario.seed}</dd>
      </dl>
      <h2>{t("scenario.latency")}</h2>
      {Object.keys(stages).length === 0 && <p class="muted">{t("scenario.noHazard")}</p>}
      <ul class="rows stages">
        {Object.entries(stages).map(([stage, spent]) => (
          <li key={stage} class="row">
            <span>{stage}</span>
            <progress max={longest} value={Math.max(0, spent)} aria-label={stage} />
            <span class="value">{decimal(spent, 0)} ms</span>
          </li>
        ))}
      </ul>
      {scenario.hazard_to_path !== null && <p id="total">{t("scenario.total", { ms: decimal(scenario.hazard_to_path, 0) })}</p>}
      <h2>{t("scenario.events")}</h2>
      <ol class="rows" reversed>
        {[...events].reverse().map(([at, text]) => (
          <li key={`${at} ${text}`} class="row"><time>{decimal(at, 1)} s</time><span>{text}</span></li>
        ))}
      </ol>
      <h2>{t("scenario.processes")}</h2>
      <table>
        <thead><tr><th>{t("scenario.process")}</th><th>{t("robot.cpu")}</th><th>{t("scenario.memory")}</th></tr></thead>
        <tbody>
          {Object.entries(processes).map(([name, [cpu, memory]]) => (
            <tr key={name}><td>{name}</td><td>{decimal(cpu, 0)} %</td><td>{decimal(memory, 0)} MB</td></tr>
          ))}
        </tbody>
      </table>
    </>
  );
}

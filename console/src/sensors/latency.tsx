// How long it took from a hazard's first reading to the robot's wheels, by stage.
import { useLive } from "../context";
import { t } from "../i18n/i18n";
import type { RobotState } from "../api/types";
import { clockTime, decimal } from "../text";

type Trace = RobotState["traces"][number];
const STAMPS = ["first_reading", "confirmed", "costmap_published", "plan_published", "path_received", "first_command"] as const;
const STAGES = ["debounce", "costmap", "plan", "deliver", "command"] as const;
const SHOWN = 5;

/** Return how long (s) each stage took, and all together; null where a stamp is missing. */
export function stagesOf(trace: Trace): { readonly stages: readonly (number | null)[]; readonly total: number | null } {
  const stamps = STAMPS.map((name) => trace[name]);
  const between = (begin: number | undefined, end: number | undefined): number | null => (begin && end ? end - begin : null);
  return { stages: STAGES.map((_, i) => between(stamps[i], stamps[i + 1])), total: between(stamps[0], stamps.at(-1)) };
}

/** Return the traces that robots have, the latest first. */
export function latestTraces(robots: Iterable<{ readonly id: string; readonly state: RobotState | null }>): { readonly robot: string; readonly trace: Trace }[] {
  return [...robots]
    .flatMap(({ id, state }) => (state?.traces ?? []).map((trace) => ({ robot: id, trace })))
    .sort((a, b) => b.trace.first_reading - a.trace.first_reading)
    .slice(0, SHOWN);
}

export function Latency(): preact.JSX.Element | null {
  const live = useLive(["robot"]);
  const rows = latestTraces(live.of.robot.values());
  if (rows.length === 0) return null;
  const seconds = (value: number | null): string => (value === null ? "–" : decimal(value, 2));
  return (
    <section>
      <h2>{t("latency.title")}</h2>
      <div class="wide-table" role="group" aria-label={t("latency.title")} tabIndex={0}>
        <table>
          <thead>
            <tr>
              <th scope="col">{t("latency.what")}</th>
              {STAGES.map((stage) => <th key={stage} scope="col">{t(`latency.${stage}`)}</th>)}
              <th scope="col">{t("latency.total")}</th>
            </tr>
          </thead>
          <tbody>
            {rows.map(({ robot, trace }) => {
              const { stages, total } = stagesOf(trace);
              return (
                <tr key={`${robot} ${trace.area} ${trace.epoch} ${trace.seq}`}>
                  <th scope="row"><bdi>{trace.area}</bdi>, <bdi>{robot}</bdi> <span class="muted">{trace.first_reading ? clockTime(trace.first_reading) : "–"}</span></th>
                  {stages.map((stage, i) => <td key={STAGES[i]} class="value">{seconds(stage)}</td>)}
                  <td class="value"><b>{seconds(total)}</b></td>
                </tr>
              );
            })}
          </tbody>
        </table>
      </div>
    </section>
  );
}

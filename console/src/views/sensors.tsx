// What watches the floor: areas with their state, and the nodes with their health.
import { useEffect, useState } from "preact/hooks";
import type { AreaView, NodeValue } from "../api/types";
import { mayOperate, useConsole, useLive, useSeconds } from "../context";
import { said, saidCause } from "../i18n/codes";
import { t } from "../i18n/i18n";
import { toPoint } from "../map/geometry";
import { go, routeHash, useRoute } from "../router";
import { AreaForm } from "../sensors/area-form";
import { History } from "../sensors/history";
import { Latency } from "../sensors/latency";
import { Override } from "../sensors/override";
import { areaText, shownState } from "../sensors/words";
import { duration } from "../text";
import "../zones/zones.css";

const NEW = "+area";

export function SensorsView(): preact.JSX.Element {
  const { session, floor } = useConsole();
  const live = useLive(["area", "node", "ready"]);
  const { chosen } = useRoute();
  const [placing, setPlacing] = useState(false);
  useEffect(() => setPlacing(false), [chosen]);
  const operates = mayOperate(session);
  const areas = [...live.of.area.values()].sort((a, b) => nameOf(a).localeCompare(nameOf(b)));
  const nodes = [...live.of.node].sort(([, a], [, b]) => a.id.localeCompare(b.id));
  const ids = [...new Set(nodes.map(([, node]) => node.id))];
  const area = live.of.area.get(chosen);
  if (operates && (chosen === NEW || (area && placing))) {
    return (
      <AreaForm key={chosen} area={area ?? null} nodes={ids} onDone={(id) => {
        setPlacing(false);
        go("sensors", id);
      }} />
    );
  }
  if (area) return <AreaCard area={area} nodes={nodes.filter(([, node]) => node.area === chosen)} onPlace={() => setPlacing(true)} />;
  return (
    <>
      <h2>{t("map.hazards")}</h2>
      {operates && <div class="choices"><button onClick={() => go("sensors", NEW)}>{t("sensors.new")}</button></div>}
      {live.ready && areas.length === 0 && <p class="muted">{t("sensors.none")}</p>}
      <ul class="rows">
        {areas.map((each) => (
          <li key={each.definition.id} class="row">
            <span class={`swatch ${shownState(each)}`} aria-hidden="true" />
            <a href={routeHash("sensors", each.definition.id)}><bdi>{nameOf(each)}</bdi></a>
            <span class="value">{areaText(each)}</span>
          </li>
        ))}
      </ul>
      <h2>{t("sensors.nodes")}</h2>
      <ul class="rows">
        {nodes.map(([id, node]) => (
          <NodeRow key={id} node={node} onShow={node.x === undefined ? null : () => floor?.show([[node.x ?? 0, node.y ?? 0]])} />
        ))}
      </ul>
      <Latency />
    </>
  );
}

function nameOf({ definition }: AreaView): string {
  return definition.label || definition.id;
}

interface RowProps {
  readonly node: NodeValue;
  /** Shows where it hangs; null where nobody says. */
  readonly onShow: (() => void) | null;
}

function NodeRow({ node, onShow }: RowProps): preact.JSX.Element {
  const { live } = useConsole();
  useSeconds();
  // What is told of a node may have been its last word: it grows older here, also while the server is silent.
  const now = (live.serverTime || Date.now() / 1000) + live.silence / 1000;
  const health = node.online === false ? t("sensors.offline") : t(`state.${node.state}`);
  return (
    <li class="row node">
      <span class={`swatch ${node.state}`} aria-hidden="true" />
      <b><bdi>{node.id}</bdi></b>
      <a href={routeHash("sensors", node.area)}><bdi>{node.area}</bdi></a>
      <span class="value">{health}{node.heard !== null && ` · ${t("ago", { age: duration(now - node.heard) })}`}</span>
      <span class="why"><bdi>{said(node.code, node.reason)}</bdi>{node.code !== "" && <code> {node.code}</code>}</span>
      {onShow && <button aria-label={t("zones.showOf", { zone: node.id })} onClick={onShow}>{t("zones.show")}</button>}
      <details>
        <summary>{t("sensors.care")}</summary>
        <p>{t("sensors.received", { received: node.received, ignored: node.ignored })}</p>
        <p>{t("sensors.calibrate")} <code>./fognav node calibrate {node.id}</code></p>
        <p>{t("sensors.replace")} <code>./fognav node replace {node.id}</code></p>
      </details>
    </li>
  );
}

interface CardProps {
  readonly area: AreaView;
  /** The nodes that watch it, by what the stream calls them. */
  readonly nodes: readonly (readonly [string, NodeValue])[];
  readonly onPlace: () => void;
}

function AreaCard({ area, nodes, onPlace }: CardProps): preact.JSX.Element {
  const { session, floor, live } = useConsole();
  useSeconds();
  const { definition, hazard } = area;
  const show = (): void => floor?.show(definition.polygon.map(toPoint));
  useEffect(show, [definition.id, floor]);
  return (
    <>
      <p><a href={routeHash("sensors")}>{t("sensors.all")}</a></p>
      <h2 class="named"><bdi>{nameOf(area)}</bdi></h2>
      <dl class="facts">
        <dt>{t("field.state")}</dt><dd>{areaText(area)}{area.withheld && ` (${t("sensors.withheld")})`}</dd>
        <dt>{t("sensors.cause")}</dt><dd><bdi>{hazard ? saidCause(hazard.code, hazard.decided_by, hazard.cause) : "–"}</bdi></dd>
        <dt>{t("sensors.placeBy")}</dt><dd>{definition.cone_of ? t("sensors.byCone", { node: definition.cone_of }) : t("shape.corners", { number: definition.polygon.length })}</dd>
      </dl>
      <div class="actions">
        <button onClick={show}>{t("zones.show")}</button>
        {mayOperate(session) && <button onClick={onPlace}>{t("sensors.place")}</button>}
      </div>
      {mayOperate(session) && <Override area={area} />}
      <h3>{t("sensors.nodes")}</h3>
      <ul class="rows">{nodes.map(([id, node]) => <NodeRow key={id} node={node} onShow={null} />)}</ul>
      <History area={definition.id} since={hazard?.since ?? 0} now={live.serverTime || Date.now() / 1000} />
    </>
  );
}

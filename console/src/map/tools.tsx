// The buttons on the map: everything that wheel, pinch and drag do has a button, too.
import { useEffect, useState } from "preact/hooks";
import { useConsole } from "../context";
import { t } from "../i18n/i18n";

const PAN_PX = 120;

export function MapTools(): preact.JSX.Element {
  const { floor, robot, live } = useConsole();
  const [follows, setFollows] = useState(false);
  const [costs, setCosts] = useState(true);
  const [scan, setScan] = useState(false);

  useEffect(() => {
    if (!floor) return;
    const changed = (): void => setFollows(floor.following);
    floor.element.addEventListener("followchange", changed);
    return () => floor.element.removeEventListener("followchange", changed);
  }, [floor]);
  useEffect(() => floor?.showCosts(costs), [floor, costs]);
  useEffect(() => live.watchScan(scan ? robot : null), [live, scan, robot]);

  const pan = (x: number, y: number): void => void floor?.map.panBy([x * PAN_PX, y * PAN_PX], { animate: false });
  return (
    <div class="tools" role="toolbar" aria-label={t("view.map")}>
      <button aria-label={t("map.zoomIn")} onClick={() => floor?.map.zoomIn()}>+</button>
      <button aria-label={t("map.zoomOut")} onClick={() => floor?.map.zoomOut()}>−</button>
      <span class="pan">
        <button aria-label={t("map.left")} onClick={() => pan(-1, 0)}>←</button>
        <button aria-label={t("map.up")} onClick={() => pan(0, -1)}>↑</button>
        <button aria-label={t("map.down")} onClick={() => pan(0, 1)}>↓</button>
        <button aria-label={t("map.right")} onClick={() => pan(1, 0)}>→</button>
      </span>
      <button onClick={() => { floor?.follow(false); floor?.fit(); }}>{t("map.fit")}</button>
      {robot !== null && (
        <button aria-pressed={follows} onClick={() => floor?.follow(!follows)}>{t("map.follow", { robot })}</button>
      )}
      <details class="layers">
        <summary>{t("map.layers")}</summary>
        <div class="card">
          <label><input type="checkbox" checked={costs} onChange={() => setCosts(!costs)} /> {t("map.costs")}</label>
          {robot !== null && (
            <label><input type="checkbox" checked={scan} onChange={() => setScan(!scan)} /> {t("map.scan", { robot })}</label>
          )}
          <Legend />
        </div>
      </details>
    </div>
  );
}

const LEGEND = ["robot", "path", "obstacle", "blocked", "unknown", "clear", "zone"] as const;

function Legend(): preact.JSX.Element {
  return (
    <ul class="rows legend" aria-label={t("map.legend")}>
      {LEGEND.map((name) => (
        <li key={name} class="row"><span class={`swatch ${name}`} aria-hidden="true" /><span>{t(`legend.${name}`)}</span></li>
      ))}
    </ul>
  );
}

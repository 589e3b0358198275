// Another map, for administrators: choose its files, see what would lie in a wall, put it into force, and go back.
import L from "leaflet";
import { useEffect, useRef, useState } from "preact/hooks";
import { Problem, request } from "../api/client";
import type { MapPreview, MapState } from "../api/types";
import { useConsole, useLive } from "../context";
import { t } from "../i18n/i18n";
import { sentence } from "../stop";

/** Looking at a large map takes its time on a small computer. */
const LOOK_MS = 90_000;
const BYTES_AT_ONCE = 0x8000;

export function MapChange(): preact.JSX.Element {
  const { floor, live, say } = useConsole();
  const epoch = useLive(["map"]).map?.epoch ?? 0;
  const [state, setState] = useState<MapState | null>(null);
  const [seen, setSeen] = useState<MapPreview | null>(null);
  const [busy, setBusy] = useState<"" | "looking" | "changing">("");
  const [problem, setProblem] = useState("");
  const [accepted, setAccepted] = useState(false);
  const picture = useRef<HTMLInputElement>(null);
  const yaml = useRef<HTMLInputElement>(null);
  const preview = useRef<HTMLElement>(null);

  useEffect(() => {
    let wanted = true;
    void request<MapState>("GET", "map/state").then(
      ({ value }) => wanted && setState(value),
      () => undefined, // it is being started again: the next epoch asks anew
    );
    setSeen(null);
    setBusy("");
    return () => {
      wanted = false;
    };
  }, [epoch, live]);

  useEffect(() => {
    if (!floor || !seen) return;
    preview.current?.scrollIntoView({ block: "nearest" });
    const drawn = previewLayer(seen).addTo(floor.map);
    if (seen.findings.length > 0) floor.show(seen.findings.map(({ x, y }) => [x, y]));
    return () => void drawn.remove();
  }, [floor, seen]);

  const failed = (error: unknown): void => {
    const stale = error instanceof Problem && error.status === 412;
    setProblem(sentence(error));
    setBusy("");
    if (stale) setSeen(null);
  };
  const look = async (body: unknown): Promise<void> => {
    setBusy("looking");
    setProblem("");
    setAccepted(false);
    setSeen((await request<MapPreview>("POST", "map/preview", { body, timeout: LOOK_MS })).value);
    setBusy("");
  };
  const lookAtFiles = async (): Promise<void> => {
    const files = [yaml.current?.files?.[0], picture.current?.files?.[0]] as const;
    if (!files[0] || !files[1]) return setProblem(t("change.choose"));
    await look({ upload: { yaml: await files[0].text(), image: base64(await files[1].arrayBuffer()) } });
  };
  const apply = async (): Promise<void> => {
    if (!seen) return;
    setBusy("changing");
    await request("PUT", "map", { body: { preview: seen.id, accept: accepted }, timeout: LOOK_MS });
    say(t("change.done"));
  };
  return (
    <details class="change">
      <summary>{t("change.title")}</summary>
      <p class="muted">{t("change.about")}</p>
      <div class="fields">
        <label>{t("change.yaml")}<input ref={yaml} type="file" accept=".yaml,.yml" /></label>
        <label>{t("change.picture")}<input ref={picture} type="file" accept=".pgm,.png,image/png" /></label>
      </div>
      <div class="actions">
        <button disabled={busy !== ""} onClick={() => void lookAtFiles().catch(failed)}>{t("change.look")}</button>
        {state?.back && <button disabled={busy !== ""} onClick={() => void look({ back: true }).catch(failed)}>{t("change.back")}</button>}
      </div>
      {busy !== "" && <p role="status">{t(busy === "looking" ? "change.looking" : "change.changing")}</p>}
      {problem !== "" && <p class="problem" role="alert">{problem}</p>}
      {seen && (
        <section ref={preview} aria-label={t("change.preview")}>
          <Facts seen={seen} />
          {!seen.refused && !seen.accepted && (
            <label><input type="checkbox" checked={accepted} onChange={(event) => setAccepted(event.currentTarget.checked)} /> {t("change.accept")}</label>
          )}
          {seen.trouble !== "" && <p class="why"><bdi>{seen.trouble}</bdi></p>}
          {seen.refused ? <p class="problem">{t("change.refused")}</p> : <p>{t("change.consequence")}</p>}
          <div class="actions">
            <button class="danger" disabled={busy !== "" || seen.refused || !(seen.accepted || accepted)} onClick={() => void apply().catch(failed)}>{t("change.apply")}</button>
            <button disabled={busy === "changing"} onClick={() => setSeen(null)}>{t("cancel")}</button>
          </div>
        </section>
      )}
    </details>
  );
}

function Facts({ seen }: { readonly seen: MapPreview }): preact.JSX.Element {
  const { geometry: now, before, area } = seen;
  const size = (of: typeof now): string => `${of.width} x ${of.height}, ${of.resolution} m (${of.origin_x.toFixed(2)}, ${of.origin_y.toFixed(2)})`;
  return (
    <>
      <dl class="facts">
        <dt>{t("change.size")}</dt><dd>{size(now)}</dd>
        {size(now) !== size(before) && <><dt>{t("change.before")}</dt><dd>{size(before)}</dd></>}
        <dt>{t("change.agreement")}</dt><dd>{Math.round(100 * seen.agreement)} %</dd>
        <dt>{t("change.changed")}</dt><dd>{(100 * area.changed).toFixed(1)} %</dd>
        <dt>{t("change.toWall")}</dt><dd>{area.floor_to_wall_m2} m²</dd>
        <dt>{t("change.toFloor")}</dt><dd>{area.wall_to_floor_m2} m²</dd>
      </dl>
      <h3>{t("change.findings", { number: seen.findings.length })}</h3>
      {!seen.robots && <p class="muted">{t("change.robotsUnknown")}</p>}
      <ul class="rows">
        {seen.findings.map((one) => (
          <li key={`${one.kind} ${one.id}`} class="row">
            <b>{t(`change.kind.${one.kind}`)} <bdi>{one.id}</bdi></b>
            <span>{t(`change.code.${one.code}`)}{one.refused && ` (${t("change.mustMove")})`}</span>
            <span class="value">{one.x.toFixed(2)}, {one.y.toFixed(2)}</span>
          </li>
        ))}
      </ul>
    </>
  );
}

/** Return the new plan, with the walls that come and go, and a mark on everything that would not fit it. */
function previewLayer(seen: MapPreview): L.LayerGroup {
  const { origin_x: x, origin_y: y, width, height, resolution } = seen.geometry;
  const corners: L.LatLngBoundsLiteral = [[y, x], [y + height * resolution, x + width * resolution]];
  const plan = L.imageOverlay(`api/v1/map/previews/${seen.id}.png`, corners, { className: "cells", alt: t("change.preview") });
  const marks = seen.findings.map((one) => {
    const mark = L.circleMarker([one.y, one.x], { radius: 9, className: "finding", interactive: false });
    const text = document.createElement("bdi");
    text.textContent = one.id;
    return mark.bindTooltip(text, { permanent: true, direction: "top", className: "label draft" });
  });
  return L.layerGroup([plan, ...marks]);
}

function base64(data: ArrayBuffer): string {
  const bytes = new Uint8Array(data);
  let text = "";
  for (let at = 0; at < bytes.length; at += BYTES_AT_ONCE) text += String.fromCharCode(...bytes.subarray(at, at + BYTES_AT_ONCE));
  return btoa(text);
}

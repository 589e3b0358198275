// Where an area is: drawn on the map as a polygon, or what a sensor node sees; and which nodes watch it.
import { useEffect, useReducer, useState } from "preact/hooks";
import { Problem, request } from "../api/client";
import type { AreaBody, AreaView, AuditEntry } from "../api/types";
import { useConsole } from "../context";
import { t } from "../i18n/i18n";
import { sentence } from "../stop";
import { newDraft } from "../zones/draft";
import { EditLayer } from "../zones/edit-layer";
import { Editor } from "../zones/editor";
import { attemptOf } from "../zones/requests";
import { DrawingFields, PointFields } from "../zones/shape-fields";

interface Props {
  /** null: a new one. */
  readonly area: AreaView | null;
  /** Ids of all nodes of the site. */
  readonly nodes: readonly string[];
  readonly onDone: (id: string) => void;
}

/** Return an editor of a polygon. */
function polygonEditor(area: AreaView | null): Editor {
  const editor = new Editor();
  const draft = newDraft("polygon");
  editor.start(area ? { ...draft, fields: { ...draft.fields, shape: { type: "polygon", points: area.definition.polygon } } } : draft);
  return editor;
}

/** Return what is sent: all that the page does not edit stays as it is. */
export function areaBody(area: AreaView | null, change: Pick<AreaBody, "label" | "nodes" | "cone_of" | "polygon">): AreaBody {
  const { id: _id, version: _version, epoch: _epoch, polygon: _polygon, ...kept } = { ...area?.definition } as Partial<AreaView["definition"]>;
  return { ...kept, ...change };
}

export function AreaForm({ area, nodes, onDone }: Props): preact.JSX.Element {
  const { floor, say } = useConsole();
  const [editor] = useState(() => polygonEditor(area));
  const [id, setId] = useState(area?.definition.id ?? "");
  const [label, setLabel] = useState(area?.definition.label ?? "");
  const [watching, setWatching] = useState<readonly string[]>(area?.definition.nodes ?? []);
  const [coneOf, setConeOf] = useState(area?.definition.cone_of ?? "");
  const [problem, setProblem] = useState("");
  /** What somebody else has made of the area meanwhile. */
  const [theirs, setTheirs] = useState<Theirs | null>(null);
  const [, redraw] = useReducer((count: number) => count + 1, 0);
  useEffect(() => editor.on(() => redraw(0)), [editor]);
  useEffect(() => {
    if (!floor || coneOf !== "") return;
    const layer = new EditLayer(floor, editor);
    return () => layer.remove();
  }, [floor, editor, coneOf]);

  const { shape } = editor;
  const polygon = coneOf === "" && shape?.type === "polygon" ? shape.points : null;
  const complete = id !== "" && (coneOf !== "" || polygon !== null);
  const save = async (): Promise<void> => {
    const base = theirs?.area ?? area;
    const body = areaBody(base, { label, nodes: [...watching], cone_of: coneOf === "" ? null : coneOf, polygon });
    const condition: Record<string, string> = base ? { "If-Match": `"${base.definition.version}"` } : { "If-None-Match": "*" };
    try {
      const { key } = attemptOf(JSON.stringify([id, condition, body]), () => body);
      const headers = { ...condition, "Idempotency-Key": key };
      await request("PUT", `areas/${encodeURIComponent(id)}`, { body, headers });
      say(t("sensors.saved", { area: id }));
      onDone(id);
    } catch (error) {
      const overtaken = error instanceof Problem && error.status === 412;
      setProblem(overtaken ? t("sensors.overtaken") : sentence(error));
      if (overtaken) await readTheirs(id).then(setTheirs, () => undefined);
    }
  };
  const toggle = (node: string, on: boolean): void => {
    setWatching((now) => (on ? [...now, node] : now.filter((other) => other !== node)));
    if (!on && coneOf === node) setConeOf("");
  };
  return (
    <form class="zone-form" noValidate aria-label={t("sensors.place")} onSubmit={(event) => {
      event.preventDefault();
      void save();
    }}>
      <h2 class="named">{area ? <bdi>{id}</bdi> : t("sensors.new")}</h2>
      {!area && (
        <label class="field">{t("edit.id")}
          <input value={id} maxLength={32} required spellcheck={false} autocapitalize="none" title={t("edit.idHelp")} onInput={(event) => setId(event.currentTarget.value)} />
        </label>
      )}
      <label class="field">{t("sensors.label")}
        <input dir="auto" value={label} maxLength={100} onInput={(event) => setLabel(event.currentTarget.value)} />
      </label>
      <fieldset>
        <legend>{t("sensors.watching")}</legend>
        {nodes.map((node) => (
          <label key={node} class="check"><input type="checkbox" checked={watching.includes(node)} onChange={(event) => toggle(node, event.currentTarget.checked)} /> {node}</label>
        ))}
      </fieldset>
      <label class="field">{t("sensors.placeBy")}
        <select value={coneOf} onChange={(event) => setConeOf(event.currentTarget.value)}>
          <option value="">{t("sensors.byPolygon")}</option>
          {watching.map((node) => <option key={node} value={node}>{t("sensors.byCone", { node })}</option>)}
        </select>
      </label>
      {coneOf === "" && <DrawingFields editor={editor} types={["polygon"]} />}
      {coneOf === "" && <PointFields editor={editor} />}
      {theirs && (
        <SideBySide theirs={theirs} mine={{ label, nodes: watching, cone_of: coneOf === "" ? null : coneOf, polygon: polygon ?? [] }} onTheirs={() => onDone(id)} />
      )}
      <div class="sticky">
        <p class="problem" role="alert">{problem}</p>
        <div class="actions">
          <button class="primary" disabled={!complete}>{t("edit.save")}</button>
          <button type="button" onClick={() => onDone(area?.definition.id ?? "")}>{t("cancel")}</button>
        </div>
      </div>
    </form>
  );
}

interface Theirs {
  readonly area: AreaView;
  readonly who: string;
}

async function readTheirs(id: string): Promise<Theirs> {
  const { value: area } = await request<AreaView>("GET", `areas/${encodeURIComponent(id)}`);
  const { value: entries } = await request<AuditEntry[]>("GET", "audit?kind=area&limit=200");
  return { area, who: entries.find((entry) => entry.id === id)?.who ?? "?" };
}

type Edited = Pick<AreaView["definition"], "label" | "cone_of"> & { readonly nodes: readonly string[]; readonly polygon: readonly unknown[] };

interface SideProps {
  readonly mine: Edited;
  readonly theirs: Theirs;
  readonly onTheirs: () => void;
}

/** Both versions of an area beside each other; saving now replaces theirs by mine. */
function SideBySide({ mine, theirs, onTheirs }: SideProps): preact.JSX.Element {
  const other = theirs.area.definition;
  const place = (of: Edited): string => (of.cone_of ? t("sensors.byCone", { node: of.cone_of }) : t("shape.corners", { number: of.polygon.length }));
  const rows = [
    [t("sensors.label"), mine.label, other.label],
    [t("sensors.watching"), mine.nodes.join(", "), (other.nodes ?? []).join(", ")],
    [t("sensors.placeBy"), place(mine), place({ ...other, nodes: other.nodes ?? [] })],
  ] as const;
  return (
    <section class="conflict card" role="alertdialog" aria-label={t("conflict.title")}>
      <h3>{t("conflict.title")}</h3>
      <table>
        <thead>
          <tr><th scope="col">{t("conflict.field")}</th><th scope="col">{t("conflict.mine")}</th><th scope="col">{t("conflict.theirs", { who: theirs.who })}</th></tr>
        </thead>
        <tbody>
          {rows.map(([field, own, their]) => (
            <tr key={field}><th scope="row">{field}</th><td><bdi>{own || "–"}</bdi></td><td><bdi>{their || "–"}</bdi></td></tr>
          ))}
        </tbody>
      </table>
      <div class="actions">
        <button class="primary">{t("sensors.saveMine")}</button>
        <button type="button" onClick={onTheirs}>{t("sensors.keepTheirs")}</button>
      </div>
    </section>
  );
}

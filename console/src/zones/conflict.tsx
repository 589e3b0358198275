// Two operators have changed the same zone: both versions side by side, and a choice for each field.
import { useState } from "preact/hooks";
import type { Shape, Zone } from "../api/types";
import { t } from "../i18n/i18n";
import { decimal } from "../text";
import { type Choice, type FieldName, type Fields, fieldsOf, merged, suggested } from "./draft";
import type { Editor } from "./editor";
import { scheduleText } from "./schedule";
import { middle } from "./shapes";
import { endText } from "./words";

interface Props {
  readonly editor: Editor;
  /** Save what was chosen. */
  readonly onSave: () => void;
  readonly onDrop: () => void;
}

export function Conflict({ editor, onSave, onDrop }: Props): preact.JSX.Element | null {
  const { draft, theirs } = editor;
  if (!draft || theirs === undefined) return null;
  return theirs === null
    ? <Gone editor={editor} onSave={onSave} onDrop={onDrop} />
    : <SideBySide key={theirs.version} editor={editor} theirs={theirs} onSave={onSave} onDrop={onDrop} />;
}

function Gone({ editor, onSave, onDrop }: Props): preact.JSX.Element {
  return (
    <section class="conflict card" role="alertdialog" aria-label={t("conflict.title")}>
      <h3>{t("conflict.title")}</h3>
      <p>{t("conflict.gone")}</p>
      <div class="actions">
        <button type="button" class="primary" onClick={() => {
          if (editor.draft) editor.rebase(null, editor.draft.fields);
          onSave();
        }}>{t("conflict.again")}</button>
        <button type="button" onClick={onDrop}>{t("conflict.drop")}</button>
      </div>
    </section>
  );
}

function SideBySide({ editor, theirs, onSave, onDrop }: Props & { readonly theirs: Zone }): preact.JSX.Element | null {
  const { draft } = editor;
  const others = fieldsOf(theirs);
  const base = draft?.base ? fieldsOf(draft.base) : others;
  const [choices, setChoices] = useState(() => (draft ? suggested(base, draft.fields, others) : new Map<FieldName, Choice>()));
  if (!draft) return null;
  const mine = draft.fields;
  const choose = (name: FieldName, choice: Choice): void => setChoices((now) => new Map(now).set(name, choice));
  const all = (choice: Choice): void => setChoices((now) => new Map([...now.keys()].map((name) => [name, choice])));
  return (
    <section class="conflict card" role="alertdialog" aria-label={t("conflict.title")}>
      <h3>{t("conflict.title")}</h3>
      <p>{t("conflict.text", { who: theirs.author, zone: theirs.id })}</p>
      <table>
        <thead>
          <tr><th scope="col">{t("conflict.field")}</th><th scope="col">{t("conflict.mine")}</th><th scope="col">{t("conflict.theirs", { who: theirs.author })}</th></tr>
        </thead>
        <tbody>
          {[...choices].map(([name, chosen]) => (
            <tr key={name}>
              <th scope="row">{t(`field.${name}`)}</th>
              {(["mine", "theirs"] as const).map((side) => (
                <td key={side} class={chosen === side ? "chosen" : ""}>
                  <label>
                    <input type="radio" name={`choice-${name}`} checked={chosen === side} onChange={() => choose(name, side)} />
                    <bdi>{fieldText(name, side === "mine" ? mine : others)}</bdi>
                  </label>
                </td>
              ))}
            </tr>
          ))}
        </tbody>
      </table>
      {choices.size === 0 && <p class="fine">{t("conflict.same")}</p>}
      <p class="muted">{t("conflict.map")}</p>
      <div class="actions">
        <button type="button" onClick={() => all("mine")}>{t("conflict.allMine")}</button>
        <button type="button" onClick={() => all("theirs")}>{t("conflict.allTheirs")}</button>
      </div>
      <div class="actions">
        <button type="button" class="primary" onClick={() => {
          editor.rebase(theirs, merged(mine, others, choices));
          onSave();
        }}>{t("conflict.save")}</button>
        <button type="button" onClick={() => editor.rebase(theirs, merged(mine, others, choices))}>{t("conflict.goOn")}</button>
        <button type="button" onClick={onDrop}>{t("conflict.drop")}</button>
      </div>
    </section>
  );
}

function fieldText(name: FieldName, fields: Fields): string {
  switch (name) {
    case "kind":
      return t(`zone.${fields.kind}`);
    case "shape":
      return fields.shape ? shapeText(fields.shape) : "–";
    case "factor":
      return decimal(fields.factor, 1);
    case "speed":
      return `${decimal(fields.speed, 2)} m/s`;
    case "reason":
      return fields.reason || "–";
    case "end":
      return endText(fields.end);
    case "schedule":
      return fields.schedule ? scheduleText(fields.schedule) : t("schedule.none");
    case "sets":
      return fields.sets.join(", ") || "–";
    case "enabled":
      return t(fields.enabled ? "state.on" : "state.off");
  }
}

/** Return a shape in one line: its kind, its size and where it is. */
export function shapeText(shape: Shape): string {
  const [x, y] = middle(shape);
  return `${t(`shape.${shape.type}`)}, ${sizeText(shape)}, ${decimal(x, 2)}; ${decimal(y, 2)}`;
}

function sizeText(shape: Shape): string {
  switch (shape.type) {
    case "rectangle":
      return `${decimal(Math.abs(shape.opposite[0] - shape.corner[0]), 2)} × ${decimal(Math.abs(shape.opposite[1] - shape.corner[1]), 2)} m`;
    case "circle":
      return `r = ${decimal(shape.radius, 2)} m`;
    case "polygon":
      return t("shape.corners", { number: shape.points.length });
    case "corridor":
      return `${t("shape.points", { number: shape.line.length })}, ${decimal(shape.width, 2)} m`;
  }
}

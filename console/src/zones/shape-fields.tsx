// The shape in numbers and buttons: all that a drag on the map does can be done here by single clicks and by keys.
import type { Point } from "../api/types";
import { useConsole } from "../context";
import { t } from "../i18n/i18n";
import { Typed } from "../typed";
import { outline } from "../map/geometry";
import { pointName } from "./edit-layer";
import type { ClickMode, Editor } from "./editor";
import { hasCorners, middle, SHAPE_TYPES, shapeAt, shapePoints, type ShapeType, WHOLE } from "./shapes";

const STEPS = [0.05, 0.25, 1] as const;
const MODES: readonly ClickMode[] = ["add", "move", "none"];
const COORDINATE_MAX = 10_000;

interface Props {
  readonly editor: Editor;
}

/** What is drawn, and what a click on the map does. */
export function DrawingFields({ editor, types = SHAPE_TYPES }: Props & { readonly types?: readonly ShapeType[] }): preact.JSX.Element | null {
  const { draft, shape, sketch, mode } = editor;
  const { floor } = useConsole();
  if (!draft) return null;
  const centre = (): Point => {
    const at = floor?.map.getCenter();
    return at ? [at.lng, at.lat] : [0, 0];
  };
  const canAdd = shape === null || hasCorners(shape);
  return (
    <fieldset class="shape-fields">
      <legend>{t("edit.shape")}</legend>
      <div class="choices" role="group" aria-label={t("edit.shape")}>
        {types.length > 1 && types.map((type) => (
          <button type="button" key={type} aria-pressed={draft.type === type} onClick={() => draft.type !== type && editor.redraw(type)}>
            {t(`shape.${type}`)}
          </button>
        ))}
      </div>
      <p class="muted">{shape ? t("edit.helpShape") : t(`edit.help.${draft.type}`)}</p>
      <div class="choices" role="group" aria-label={t("edit.click")}>
        <span class="muted">{t("edit.click")}</span>
        {MODES.filter((each) => (each === "add" ? canAdd : shape !== null)).map((each) => (
          <button type="button" key={each} aria-pressed={mode === each} onClick={() => editor.setMode(each)}>
            {t(each === "move" ? (editor.selected === WHOLE ? "mode.moveAll" : "mode.movePoint") : `mode.${each}`)}
          </button>
        ))}
      </div>
      <div class="choices">
        {mode !== "none" && <button type="button" onClick={() => editor.click(centre())}>{t("edit.atCrosshair")}</button>}
        {shape === null && sketch.length === 0 && (
          <button type="button" onClick={() => {
            const placed = shapeAt(draft.type, centre());
            editor.place(placed);
            floor?.show(outline(placed));
          }}>{t("edit.place")}</button>
        )}
        <button type="button" disabled={!editor.canUndo} onClick={() => editor.undo()}>{t("edit.undoStep")}</button>
      </div>
    </fieldset>
  );
}

/** Where the shape is, in numbers, and buttons that move it. */
export function PointFields({ editor }: Props): preact.JSX.Element | null {
  if (!editor.shape) return null;
  return (
    <fieldset>
      <legend>{t("edit.points")}</legend>
      <Arrows editor={editor} />
      <Points editor={editor} />
    </fieldset>
  );
}

/** Buttons that move the selected point, or all. */
function Arrows({ editor }: Props): preact.JSX.Element {
  const { shape, selected, step } = editor;
  const name = shape && selected !== WHOLE ? pointName(shape, selected) : t("edit.whole");
  return (
    <div class="arrows" role="group" aria-label={t("edit.moving", { name })}>
      <span class="what"><b>{name}</b></span>
      <button type="button" aria-label={t("edit.left", { name })} onClick={() => editor.nudge(selected, -1, 0)}>←</button>
      <button type="button" aria-label={t("edit.up", { name })} onClick={() => editor.nudge(selected, 0, 1)}>↑</button>
      <button type="button" aria-label={t("edit.down", { name })} onClick={() => editor.nudge(selected, 0, -1)}>↓</button>
      <button type="button" aria-label={t("edit.right", { name })} onClick={() => editor.nudge(selected, 1, 0)}>→</button>
      <label class="step">{t("edit.step")}
        <select value={String(step)} onChange={(event) => {
          editor.step = Number(event.currentTarget.value);
        }}>
          {STEPS.map((each) => <option key={each} value={String(each)}>{`${each} m`}</option>)}
        </select>
      </label>
    </div>
  );
}

/** The table of coordinates. */
function Points({ editor }: Props): preact.JSX.Element | null {
  const { shape, selected } = editor;
  if (!shape) return null;
  const corners = hasCorners(shape);
  const [x, y] = middle(shape);
  const rows = shape.type === "circle" ? [] : shapePoints(shape).map((at, index) => ({ at, index }));
  return (
    <>
      <table class="points">
        <caption class="muted">{t("edit.table")}</caption>
        <thead>
          <tr><th scope="col">{t("edit.pointHead")}</th><th scope="col">x</th><th scope="col">y</th>{corners && <th scope="col"><span class="unseen">{t("edit.change")}</span></th>}</tr>
        </thead>
        <tbody>
          <Row editor={editor} index={shape.type === "circle" ? 0 : WHOLE} at={[x, y]} name={t(shape.type === "circle" ? "edit.centre" : "edit.middle")} chosen={selected === (shape.type === "circle" ? 0 : WHOLE)} />
          {rows.map(({ at, index }) => (
            <Row key={index} editor={editor} index={index} at={at} name={pointName(shape, index)} chosen={selected === index}>
              {corners && (
                <td class="row-actions">
                  <button type="button" aria-label={t("edit.insertAfter", { number: index + 1, x: at[0], y: at[1] })} onClick={() => editor.addCorner(index)}>+</button>
                  <button type="button" aria-label={t("edit.remove", { name: pointName(shape, index) })} onClick={() => editor.removeCorner(index)}>✕</button>
                </td>
              )}
            </Row>
          ))}
        </tbody>
      </table>
      {shape.type === "circle" && (
        <label class="field">{t("edit.radius")}
          <Metres value={shape.radius} min={0.1} max={1000} label={t("edit.radius")} onValue={(radius) => editor.set({ shape: { ...shape, radius } })} />
        </label>
      )}
      {shape.type === "corridor" && (
        <label class="field">{t("edit.width")}
          <Metres value={shape.width} min={0.1} max={1000} label={t("edit.width")} onValue={(width) => editor.set({ shape: { ...shape, width } })} />
        </label>
      )}
    </>
  );
}

interface RowProps extends Props {
  readonly index: number;
  readonly at: Point;
  readonly name: string;
  readonly chosen: boolean;
  readonly children?: preact.ComponentChildren;
}

function Row({ editor, index, at: [x, y], name, chosen, children }: RowProps): preact.JSX.Element {
  return (
    <tr class={chosen ? "chosen" : ""}>
      <th scope="row">
        <button type="button" aria-pressed={chosen} onClick={() => editor.select(index)}>{name}</button>
      </th>
      <td><Metres value={x} label={`${name} x`} onValue={(value) => editor.movePoint(index, [value, y])} /></td>
      <td><Metres value={y} label={`${name} y`} onValue={(value) => editor.movePoint(index, [x, value])} /></td>
      {children ?? (editor.shape && hasCorners(editor.shape) && <td />)}
    </tr>
  );
}

interface MetresProps {
  readonly value: number;
  readonly label: string;
  readonly min?: number;
  readonly max?: number;
  readonly onValue: (value: number) => void;
}

/** A number in metres, which counts once it is complete; what is no number goes back to what it was. */
export function Metres({ value, label, min = -COORDINATE_MAX, max = COORDINATE_MAX, onValue }: MetresProps): preact.JSX.Element {
  return (
    <Typed
      value={value.toFixed(2)}
      onTyped={({ valueAsNumber: typed }) => {
        if (Number.isFinite(typed) && typed >= min && typed <= max) onValue(typed);
      }}
    >
      {(typed) => <input type="number" inputMode="decimal" step="0.01" min={min} max={max} aria-label={label} {...typed} />}
    </Typed>
  );
}

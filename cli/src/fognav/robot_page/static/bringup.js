// Bring-up on the robot's page: what was judged of its parts, and how its lidar is mounted, set by looking at its scan.
// Nothing here moves the robot. A draft lies over what the agent runs with, and becomes robot.toml when it is written.

const element = (id) => document.getElementById(id);
const degrees = (angle) => (angle * 180) / Math.PI;
const radians = (angle) => (angle * Math.PI) / 180;
const wrapped = (angle) => Math.atan2(Math.sin(angle), Math.cos(angle));
const ORDER = ["bad", "warn", "unknown", "ok"];

let told = null;
let draft = null; // { yaw, mirrored, masks }; masks in the lidar's frame, in which its scans come, so that they turn along
let began = ""; // what the agent ran with when the draft began
let shown = "";
let listed = "";
let masking = false;
let held = null; // { bearing, sweep } while the canvas is dragged
let redraw = () => {};

const flipped = () => draft.mirrored !== told.mounted.mirrored;
const turned = (angle) => wrapped((flipped() ? -angle : angle) + draft.yaw);
const inRobot = ([from, to]) => (flipped() ? [turned(to), turned(from)] : [turned(from), turned(to)]);
const inLidar = ([from, to]) => (flipped() ? [draft.yaw - to, draft.yaw - from] : [from - draft.yaw, to - draft.yaw]).map(wrapped);
const round = (angle) => Math.round(angle * 1000) / 1000;

// Where a point of the scan (m, by the agent's settings) is if the lidar is mounted as the draft says.
export function placed(point) {
  if (!draft) return point;
  const { x, y, yaw } = told.mounted;
  const [ahead, left] = [point[0] - x, point[1] - y];
  const [range, angle] = [Math.hypot(ahead, left), turned(Math.atan2(left, ahead) - yaw)];
  return [x + range * Math.cos(angle), y + range * Math.sin(angle)];
}

// How far (m) the drawing reaches, if it is not left to the scan.
export function reach() {
  return told && element("zoom").value !== "0" ? Number(element("zoom").value) : null;
}

export function draw(g, at, colour) {
  if (!draft) return;
  const { x, y } = told.mounted;
  const fan = ([from, to], fill, alpha) => {
    const sector = inRobot([from, to]);
    const width = (((sector[1] - sector[0]) % (2 * Math.PI)) + 2 * Math.PI) % (2 * Math.PI);
    g.globalAlpha = alpha;
    g.fillStyle = fill;
    g.beginPath();
    g.moveTo(...at([x, y]));
    for (let step = 0; step <= 24; step += 1) {
      const angle = sector[0] + (width * step) / 24;
      g.lineTo(...at([x + 20 * Math.cos(angle), y + 20 * Math.sin(angle)]));
    }
    g.fill();
    g.globalAlpha = 1;
  };
  for (const sector of draft.masks) fan(sector, colour("--line"), 0.45);
  for (const sector of proposed()) fan(sector, colour("--alarm"), 0.25);
  if (held && masking) fan(inLidar(swept()), colour("--accent"), 0.35);
}

const swept = () => (held.sweep > 0 ? [held.bearing - held.sweep, held.bearing] : [held.bearing, held.bearing - held.sweep]);

// Sectors in which the lidar sees the robot itself, and which the draft does not hide yet.
function proposed() {
  const hides = (angle) => draft.masks.some(([from, to]) => wrappedUp(angle - from) <= wrappedUp(to - from));
  return told.proposed.filter(([from, to]) => !hides(from + wrappedUp(to - from) / 2));
}
const wrappedUp = (angle) => ((angle % (2 * Math.PI)) + 2 * Math.PI) % (2 * Math.PI);

export function show(news) {
  if (!news) return;
  told = news;
  element("bringup").hidden = element("mounting").hidden = false;
  document.body.classList.add("bringup");
  const mounted = JSON.stringify(news.mounted);
  if (news.mounted && mounted !== began) {
    began = mounted;
    const { yaw, mirrored, masks } = news.mounted;
    draft = { yaw, mirrored, masks: masks.map((mask) => mask.map((angle) => wrapped(angle - yaw))) };
    tell();
  }
  element("write").disabled = !draft || !news.file;
  element("write").textContent = news.file ? `Write ${news.file.split("/").pop()}` : "No robot.toml is known";
  if (draft) list();
  const now = JSON.stringify(news.findings);
  if (now === shown) return;
  shown = now;
  const found = [...news.findings].sort((a, b) => ORDER.indexOf(a.state) - ORDER.indexOf(b.state));
  element("findings").replaceChildren(...found.map(item));
}

export function disconnect() {
  element("write").disabled = true;
}

function item({ name, state, text, remedy }) {
  const line = document.createElement("li");
  line.dataset.name = name;
  line.className = state;
  const parts = [["b", state], ["span", ` ${name.replaceAll("_", " ")}: ${text}`], ["i", remedy]];
  line.append(...parts.filter(([, words]) => words).map(([tag, words]) => Object.assign(document.createElement(tag), { textContent: words })));
  return line;
}

function list() {
  const now = JSON.stringify([proposed(), draft]);
  if (now === listed) return; // a button that is replaced while it is pressed does nothing
  listed = now;
  const lines = (sectors, label, act) => sectors.map((sector) => {
    const line = document.createElement("li");
    const [from, to] = inRobot(sector).map((angle) => Math.round(degrees(angle)));
    const button = Object.assign(document.createElement("button"), { textContent: label, type: "button" });
    button.addEventListener("click", () => { act(sector); tell(); });
    line.append(`${from}° to ${to}° `, button);
    return line;
  });
  element("masks").replaceChildren(...lines(draft.masks, "Remove", (sector) => { draft.masks = draft.masks.filter((mask) => String(mask) !== String(sector)); }));
  element("proposed").replaceChildren(...lines(proposed(), "Mask it", (sector) => draft.masks.push(sector)));
}

function tell() {
  const yaw = Math.round(degrees(draft.yaw) * 10) / 10;
  for (const id of ["yaw", "yaw-exact"]) if (document.activeElement !== element(id)) element(id).value = yaw;
  element("mirrored").checked = draft.mirrored;
  list();
  redraw();
}

export function begin(say, drawAgain) {
  redraw = drawAgain;
  for (const id of ["yaw", "yaw-exact"]) {
    element(id).addEventListener("input", () => {
      if (!draft || !Number.isFinite(element(id).valueAsNumber)) return;
      draft.yaw = wrapped(radians(element(id).valueAsNumber));
      tell();
    });
  }
  element("mirrored").addEventListener("change", () => {
    if (!draft) return;
    draft.mirrored = element("mirrored").checked;
    tell();
  });
  element("zoom").addEventListener("change", redraw);
  element("mask").addEventListener("click", () => {
    masking = !masking;
    element("mask").setAttribute("aria-pressed", masking);
  });
  element("write").addEventListener("click", () => {
    say({ type: "mount", yaw_rad: draft.yaw, mirrored: draft.mirrored, masks: draft.masks.map((mask) => inRobot(mask).map(round)) });
  });
  const canvas = element("scan");
  const bearing = (event) => {
    const box = canvas.getBoundingClientRect();
    return Math.atan2(box.left + box.width / 2 - event.clientX, box.top + box.height / 2 - event.clientY);
  };
  canvas.addEventListener("pointerdown", (event) => {
    if (!draft) return;
    canvas.setPointerCapture(event.pointerId);
    held = { bearing: bearing(event), sweep: 0 };
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!held) return;
    const step = wrapped(bearing(event) - held.bearing);
    held = { bearing: held.bearing + step, sweep: held.sweep + step };
    if (!masking) draft.yaw = wrapped(draft.yaw + step);
    tell();
  });
  canvas.addEventListener("pointerup", () => {
    if (held && masking && Math.abs(held.sweep) > radians(1)) draft.masks.push(inLidar(swept()));
    if (held && masking) element("mask").click();
    held = null;
    if (draft) tell();
  });
  canvas.addEventListener("pointercancel", () => { held = null; });
}

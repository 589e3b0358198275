// The page of a running demo: draws the scene that the server streams. Coordinates are in metres, y up, until drawn.
"use strict";

const canvas = document.getElementById("map");
const context = canvas.getContext("2d");
const byId = (id) => document.getElementById(id);

let layout = null; // the static part of the scene: map, areas, nodes, places
let latest = null; // the latest changing part of the scene
let trail = [];
let floorImage = null; // the coloured map
let mapImage = null;
let view = null; // {x, y: the middle in metres, scale: pixels per metre}
let follow = false;
let drawPending = false;

const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
let colours = {};
function readColours() {
  for (const name of ["floor", "wall", "unknown-cell", "robot", "path", "trail", "goal", "blocked", "unknown", "clear",
    "obstacle", "barrier", "text", "card", "muted"]) colours[name] = css(name);
}

function rgb(colour) {
  const probe = document.createElement("canvas").getContext("2d");
  probe.fillStyle = colour;
  probe.fillRect(0, 0, 1, 1);
  return probe.getImageData(0, 0, 1, 1).data;
}

// Each pixel of the map's image is a cell: 0 free, 1 occupied, 2 unknown.
function colourMap() {
  floorImage = document.createElement("canvas");
  floorImage.width = mapImage.width;
  floorImage.height = mapImage.height;
  const surface = floorImage.getContext("2d", { willReadFrequently: true });
  surface.drawImage(mapImage, 0, 0);
  const image = surface.getImageData(0, 0, floorImage.width, floorImage.height);
  const kinds = [rgb(colours.floor), rgb(colours.wall), rgb(colours["unknown-cell"])];
  for (let i = 0; i < image.data.length; i += 4) image.data.set(kinds[image.data[i]] || kinds[1], i);
  surface.putImageData(image, 0, 0);
}

function fit() {
  const [left, bottom, right, top] = layout.extent;
  const scale = 0.94 * Math.min(canvas.clientWidth / (right - left), canvas.clientHeight / (top - bottom));
  view = { x: (left + right) / 2, y: (bottom + top) / 2, scale };
}

const px = (x) => (x - view.x) * view.scale + canvas.clientWidth / 2;
const py = (y) => (view.y - y) * view.scale + canvas.clientHeight / 2;

function line(points, close) {
  context.beginPath();
  points.forEach(([x, y], i) => (i ? context.lineTo(px(x), py(y)) : context.moveTo(px(x), py(y))));
  if (close) context.closePath();
}

function drawAreas() {
  for (const area of layout.areas) {
    const state = (latest && latest.hazards[area.id]) || "none";
    const colour = { blocked: colours.blocked, unknown: colours.unknown, clear: colours.clear }[state] || colours.muted;
    line(area.polygon, true);
    context.fillStyle = colour;
    context.globalAlpha = state === "blocked" ? 0.4 : state === "unknown" ? 0.28 : 0.14;
    context.fill();
    context.globalAlpha = 1;
    context.strokeStyle = colour;
    context.lineWidth = state === "blocked" ? 2.5 : 1;
    context.setLineDash(confirmed(area) ? [] : [6, 4]);
    context.stroke();
    context.setLineDash([]);
  }
}

// Whether a living aggregator confirms the area's state.
function confirmed(area) {
  return !latest || !latest.unconfirmed.includes(area.id);
}

// Drawn last and above the areas, so that labels are visible and hide nothing; ids when zoomed out.
function drawLabels() {
  for (const area of layout.areas) {
    const state = (latest && latest.hazards[area.id]) || "none";
    const xs = area.polygon.map(([x]) => x);
    const top = Math.max(...area.polygon.map(([, y]) => y));
    const colour = { blocked: colours.blocked, unknown: colours.unknown, clear: colours.clear }[state] || colours.muted;
    const name = (view.scale < 6 ? area.id : area.label) + (confirmed(area) ? "" : " (not confirmed)");
    label(name, px((Math.min(...xs) + Math.max(...xs)) / 2), py(top) - 11, colour);
  }
  for (const place of layout.places) label(view.scale < 6 ? place.id : place.label, px(place.x), py(place.y) - 17, colours.text);
}

function label(text, x, y, colour) {
  context.font = "600 12px system-ui, 'DejaVu Sans', sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.lineWidth = 4;
  context.strokeStyle = colours.card;
  context.strokeText(text, x, y);
  context.fillStyle = colour;
  context.fillText(text, x, y);
}

function drawNodes() {
  for (const node of layout.nodes) {
    context.strokeStyle = colours.muted;
    context.lineWidth = 1;
    context.globalAlpha = 0.5;
    for (const [direction, range] of node.beams) {
      line([[node.x, node.y], [node.x + range * Math.cos(direction), node.y + range * Math.sin(direction)]]);
      context.stroke();
    }
    context.globalAlpha = 1;
    context.fillStyle = colours.muted;
    context.fillRect(px(node.x) - 3, py(node.y) - 3, 6, 6);
  }
}

function drawPath() {
  if (trail.length > 1) {
    line(trail);
    context.strokeStyle = colours.trail;
    context.lineWidth = 2.5;
    context.stroke();
  }
  if (latest.path.length > 1) {
    line(latest.path);
    context.strokeStyle = colours.path;
    context.lineWidth = 2.5;
    context.setLineDash([7, 5]);
    context.stroke();
    context.setLineDash([]);
  }
  if (latest.goal) {
    context.strokeStyle = colours.goal;
    context.lineWidth = 3;
    context.beginPath();
    context.arc(px(latest.goal[0]), py(latest.goal[1]), 9, 0, 2 * Math.PI);
    context.stroke();
  }
}

function drawRobot() {
  const pose = latest.pose || latest.truth;
  if (!pose) return;
  const [x, y, heading] = pose;
  const size = Math.max(8, layout.radius * view.scale);
  context.save();
  context.translate(px(x), py(y));
  context.rotate(-heading);
  context.fillStyle = colours.robot;
  context.strokeStyle = colours.card;
  context.lineWidth = 2;
  context.beginPath();
  context.arc(0, 0, size, 0, 2 * Math.PI);
  context.fill();
  context.stroke();
  context.beginPath();
  context.moveTo(size * 0.75, 0);
  context.lineTo(-size * 0.35, size * 0.5);
  context.lineTo(-size * 0.35, -size * 0.5);
  context.closePath();
  context.fillStyle = colours.card;
  context.fill();
  context.restore();
}

function draw() {
  drawPending = false;
  if (!layout || !floorImage || !view) return;
  const ratio = window.devicePixelRatio || 1;
  const width = Math.round(canvas.clientWidth * ratio);
  const height = Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
  }
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.fillStyle = colours["unknown-cell"];
  context.fillRect(0, 0, canvas.clientWidth, canvas.clientHeight);
  if (follow && latest && latest.pose) {
    view.x = latest.pose[0];
    view.y = latest.pose[1];
  }
  const m = layout.map;
  const w = m.width * m.resolution * view.scale;
  const h = m.height * m.resolution * view.scale;
  context.imageSmoothingEnabled = view.scale * m.resolution < 1;
  context.drawImage(floorImage, px(m.x), py(m.y + m.height * m.resolution), w, h);
  drawAreas();
  drawNodes();
  for (const place of layout.places) {
    context.fillStyle = colours.text;
    context.beginPath();
    context.arc(px(place.x), py(place.y), 3.5, 0, 2 * Math.PI);
    context.fill();
  }
  if (latest) drawLive();
  drawLabels();
}

function drawLive() {
  for (const barrier of latest.barriers) {
    line(barrier, true);
    context.fillStyle = colours.barrier;
    context.fill();
  }
  drawPath();
  context.fillStyle = colours.obstacle;
  for (const [x, y] of latest.obstacles) context.fillRect(px(x) - 1.5, py(y) - 1.5, 3, 3);
  drawRobot();
}

function redraw() {
  if (drawPending) return;
  drawPending = true;
  requestAnimationFrame(draw);
}

// --- panels beside the map -----------------------------------------------------------------------------------------

function put(id, text) {
  const element = byId(id);
  if (element.textContent !== text) element.textContent = text;
}

const metres = (value, digits = 1) => (value === null || value === undefined ? "–" : `${value.toFixed(digits)} m`);
const TONES = { NORMAL: "good", DEGRADED: "caution", INIT: "caution", HOLD: "caution", EGRESS: "caution", DOCK: "caution", TELEOP: "caution" };

function bars() {
  const longest = Math.max(1, ...Object.values(latest.stages));
  const rows = Object.entries(latest.stages).map(([stage, duration]) => {
    const row = document.createElement("div");
    row.className = "bar";
    const name = document.createElement("b");
    name.textContent = stage;
    const bar = document.createElement("progress");
    bar.max = longest;
    bar.value = Math.max(0, duration);
    bar.setAttribute("aria-label", stage);
    const value = document.createElement("span");
    value.textContent = `${duration.toFixed(0)} ms`;
    row.append(name, bar, value);
    return row;
  });
  byId("stages").replaceChildren(...rows);
  const total = byId("total");
  if (latest.hazard_to_path !== null) {
    const strong = document.createElement("strong");
    strong.textContent = `${latest.hazard_to_path.toFixed(0)} ms`;
    total.replaceChildren("total, until the robot received the path: ", strong);
  } else total.textContent = rows.length ? "in progress" : "no hazard yet";
}

function processes() {
  const rows = Object.entries(latest.processes).map(([name, [cpu, rss]]) => {
    const row = document.createElement("tr");
    for (const text of [name, `${cpu.toFixed(0)} %`, `${rss.toFixed(0)} MB`]) {
      const cell = document.createElement("td");
      cell.textContent = text;
      row.append(cell);
    }
    return row;
  });
  byId("processes").replaceChildren(...rows);
}

let shownEvents = -1;
function events() {
  if (shownEvents === latest.event_count) return;
  shownEvents = latest.event_count;
  const rows = [...latest.events].reverse().map(([at, text]) => {
    const row = document.createElement("li");
    const time = document.createElement("time");
    time.textContent = `${at.toFixed(1)} s`;
    const description = document.createElement("span");
    description.textContent = text;
    row.append(time, description);
    return row;
  });
  byId("events").replaceChildren(...rows);
}

let listsUpdatedAt = -Infinity;
function panel() {
  put("phase", latest.outcome ? `${latest.outcome[0]}: ${latest.outcome[1]}` : latest.phase);
  put("mode", latest.mode || "no state yet");
  byId("mode").dataset.tone = latest.mode ? TONES[latest.mode] || "stopped" : "";
  put("reasons", latest.refusal || latest.reasons.join("; "));
  put("v", latest.pose ? `${latest.pose[3].toFixed(2)} m/s` : "–");
  put("distance", metres(latest.distance));
  put("togo", metres(latest.goal_distance));
  put("clearance", metres(latest.clearance, 2));
  events();
  if (performance.now() - listsUpdatedAt > 900) {
    listsUpdatedAt = performance.now();
    bars();
    processes();
  }
}

// --- input ---------------------------------------------------------------------------------------------------------

function setFollow(on) {
  follow = on;
  byId("follow").setAttribute("aria-pressed", String(on));
  if (on && view && layout) view.scale = Math.max(view.scale, 30);
  redraw();
}

function zoom(factor, x, y) {
  const mx = view.x + (x - canvas.clientWidth / 2) / view.scale;
  const my = view.y - (y - canvas.clientHeight / 2) / view.scale;
  const scale = Math.min(400, Math.max(2, view.scale * factor));
  view.x = mx + (view.x - mx) * (view.scale / scale);
  view.y = my + (view.y - my) * (view.scale / scale);
  view.scale = scale;
  redraw();
}

canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
canvas.addEventListener("pointermove", (event) => {
  if (!event.buttons || !view) return;
  setFollow(false);
  view.x -= event.movementX / view.scale;
  view.y += event.movementY / view.scale;
  redraw();
});
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  if (view) zoom(Math.exp(-event.deltaY / 400), event.offsetX, event.offsetY);
}, { passive: false });
canvas.addEventListener("dblclick", () => { setFollow(false); fit(); redraw(); });
canvas.addEventListener("keydown", (event) => {
  if (!view) return;
  const step = 60 / view.scale;
  const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
  const middle = [canvas.clientWidth / 2, canvas.clientHeight / 2];
  if (moves[event.key]) {
    setFollow(false);
    view.x += moves[event.key][0];
    view.y += moves[event.key][1];
    redraw();
  } else if (event.key === "+") zoom(1.25, ...middle);
  else if (event.key === "-") zoom(0.8, ...middle);
  else return;
  event.preventDefault();
});
byId("follow").addEventListener("click", () => setFollow(!follow));
byId("fit").addEventListener("click", () => { setFollow(false); fit(); redraw(); });
new ResizeObserver(() => { if (layout && !follow) fit(); redraw(); }).observe(canvas);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { readColours(); colourMap(); redraw(); });

// --- start ---------------------------------------------------------------------------------------------------------

async function start() {
  readColours();
  layout = await (await fetch("scene.json")).json();
  put("site", `${layout.site}, robot ${layout.robot}, seed ${layout.seed}`);
  mapImage = new Image();
  mapImage.src = "map.png";
  await mapImage.decode();
  colourMap();
  fit();
  redraw();
  const source = new EventSource("events");
  source.onopen = () => { byId("link").hidden = true; };
  source.onerror = () => { byId("link").hidden = false; };
  source.onmessage = (message) => {
    latest = JSON.parse(message.data);
    if (latest.trail_from === 0) trail = [];
    trail.push(...latest.trail);
    panel();
    redraw();
  };
}

start();

// The robot's page: draws what the agent tells, and says what the operator wants. A speed is said 20 times a second and
// counts for 0.15 s on the robot, so that letting go, hiding the page or losing the link stops it. Each speed echoes the
// server's newest tick: one that a slow link has kept for long counts for nothing.

import * as bringup from "./bringup.js";

const SAY_MS = 50;
const KEEP_MS = 1000; // a driver who says nothing for 3 s drives no more
const KEYS = {
  KeyW: [1, 0], ArrowUp: [1, 0], KeyS: [-1, 0], ArrowDown: [-1, 0],
  KeyA: [0, 1], ArrowLeft: [0, 1], KeyD: [0, -1], ArrowRight: [0, -1],
};
const element = (id) => document.getElementById(id);
const pad = element("pad");
const held = new Set();
let wish = null; // [ahead, left], -1 to 1, while the pad is held
let link = null;
let view = { mode: "", mine: false, points: [], footprint: [] };
let said = 0;
let tick = 0; // the server's newest

function connect() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  link = new WebSocket(`${scheme}://${location.host}/live${location.search}`);
  link.onmessage = (event) => {
    const { tick: newest, ...told } = JSON.parse(event.data);
    tick = newest ?? tick;
    if (Object.keys(told).length) show(told);
  };
  link.onclose = (event) => {
    letGo();
    bringup.disconnect();
    show({ mode: "not connected", mine: false, reasons: [event.reason || "the link to the robot is broken"], points: [], footprint: [] });
    if (event.code !== 4401) setTimeout(connect, 1000);
  };
}

function drives() {
  return view.mode === "TELEOP" && view.mine; // another page, or a terminal, may be the one that drives
}

function say(request) {
  if (link?.readyState === WebSocket.OPEN) link.send(JSON.stringify(request));
  else if (request.type !== "steer") element("reply").textContent = "not done: the link to the robot is broken; press again when it is back";
}

function show(told) {
  bringup.show(told.bringup);
  if (told.error) {
    element("reply").textContent = told.error;
    return;
  }
  const drove = drives();
  view = { ...view, ...told };
  if (!drove && drives()) letGo(); // what was pressed before is not meant for the robot
  element("mode").textContent = view.mode;
  element("reasons").textContent = (view.reasons ?? []).join("; ");
  document.querySelector("header").classList.toggle("alarm", ["FAULT", "PROTECTIVE_STOP", "not connected"].includes(view.mode));
  const alarms = ["bumper", "cliff", "wheel_drop"].filter((name) => view[name]).map((name) => name.replace("_", " "));
  const battery = view.battery == null ? "" : `battery ${Math.round(100 * view.battery)} %`;
  const missed = view.missed ? `${view.missed} messages missed` : "";
  element("sensors").textContent = [battery, ...alarms, `${view.points.length} returns`, missed].filter(Boolean).join(" · ");
  element("take").disabled = drives() || view.mode === "not connected";
  element("back").disabled = !drives();
  element("reset").disabled = view.mode !== "FAULT";
  pad.classList.toggle("off", !drives());
  for (const reply of told.replies ?? []) element("reply").textContent = reply.reason;
  draw();
}

function draw() {
  const canvas = element("scan");
  const scale = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
    [canvas.width, canvas.height] = [Math.round(width * scale), Math.round(height * scale)];
  }
  const ink = getComputedStyle(document.documentElement);
  const colour = (name) => ink.getPropertyValue(name).trim();
  const g = canvas.getContext("2d");
  const points = view.points.map(bringup.placed);
  const far = Math.max(1.5, ...points.map(([x, y]) => Math.hypot(x, y)).sort((a, b) => a - b).slice(0, Math.ceil(0.9 * points.length)));
  const reach = bringup.reach() ?? Math.min(8, far);
  const metre = (0.47 * Math.min(width, height)) / reach;
  const at = ([x, y]) => [width / 2 - y * metre, height / 2 - x * metre]; // ahead is up, left is left
  g.setTransform(scale, 0, 0, scale, 0, 0);
  g.clearRect(0, 0, width, height);
  g.strokeStyle = colour("--line");
  g.fillStyle = colour("--line");
  g.lineWidth = 0.5;
  for (let ring = 1; ring <= reach; ring += 1) {
    g.beginPath();
    g.arc(width / 2, height / 2, ring * metre, 0, 7);
    g.stroke();
    g.fillText(`${ring} m`, width / 2 + 3, height / 2 - ring * metre - 3);
  }
  g.fillStyle = colour("--ink");
  for (const point of points) {
    const [x, y] = at(point);
    g.fillRect(x - 1.5, y - 1.5, 3, 3);
  }
  g.strokeStyle = colour("--accent");
  g.lineWidth = 2;
  g.beginPath();
  for (const corner of view.footprint) g.lineTo(...at(corner));
  g.closePath();
  g.moveTo(...at([0, 0]));
  g.lineTo(...at([0.25, 0]));
  g.stroke();
  bringup.draw(g, at, colour);
}

function wanted() {
  if (document.hidden) return null;
  if (wish) return wish;
  if (!held.size) return null;
  const sum = [...held].map((code) => KEYS[code]).reduce(([a, b], [c, d]) => [a + c, b + d], [0, 0]);
  return sum.map((value) => Math.max(-1, Math.min(1, value)));
}

function steer() {
  const now = performance.now();
  const motion = wanted();
  pad.classList.toggle("on", Boolean(motion));
  const [ahead, left] = motion ?? [0, 0];
  element("knob").style.transform = `translate(${-left * 70}%, ${-ahead * 70}%)`;
  if (!drives() || document.hidden || (!motion && now - said < KEEP_MS)) return;
  if (link.bufferedAmount) return; // what waits here would come late
  said = now;
  const backwards = ahead < 0 ? -1 : 1; // as one steers: to the left is to the left, backwards too
  say({ type: "steer", tick, v: ahead * element("speed").value, w: backwards * left * element("turn").value });
}

function letGo() {
  const drove = wish || held.size;
  wish = null;
  held.clear();
  if (drove && drives()) say({ type: "steer", tick, v: 0, w: 0 });
}

function point(event) {
  const box = pad.getBoundingClientRect();
  const ahead = (box.top + box.height / 2 - event.clientY) / (box.height / 2);
  const left = (box.left + box.width / 2 - event.clientX) / (box.width / 2);
  const far = Math.max(1, Math.hypot(ahead, left));
  wish = [ahead / far, left / far].map((value) => (Math.abs(value) < 0.12 ? 0 : value));
}

pad.addEventListener("pointerdown", (event) => { pad.setPointerCapture(event.pointerId); point(event); });
pad.addEventListener("pointermove", (event) => { if (wish) point(event); });
for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) pad.addEventListener(name, letGo);
pad.addEventListener("contextmenu", (event) => event.preventDefault());
// macOS tells no release of a key that is let go while Cmd is down.
const withMeta = (event) => event.metaKey || event.key === "Meta";
window.addEventListener("keydown", (event) => {
  if (withMeta(event)) {
    letGo();
    return;
  }
  if (!(event.code in KEYS) || ["INPUT", "SELECT"].includes(event.target.tagName) || event.ctrlKey) return;
  event.preventDefault();
  if (!event.repeat) held.add(event.code);
});
window.addEventListener("keyup", (event) => {
  if (withMeta(event)) letGo();
  else if (held.delete(event.code) && !held.size && drives()) say({ type: "steer", tick, v: 0, w: 0 });
});
window.addEventListener("blur", letGo);
document.addEventListener("visibilitychange", letGo);
element("take").addEventListener("click", () => { say({ type: "take_over" }); pad.focus(); });
element("back").addEventListener("click", () => say({ type: "hand_back" }));
element("reset").addEventListener("click", () => say({ type: "reset" }));
for (const [id, unit] of [["speed", "m/s"], ["turn", "rad/s"]]) {
  const tell = () => { element(`${id}-shown`).textContent = `${element(id).value} ${unit}`; };
  element(id).addEventListener("input", tell);
  tell();
}
window.addEventListener("resize", draw);
setInterval(steer, SAY_MS);
bringup.begin(say, draw);
connect();

// The operator's page: shows the picture that the HMI pushes, asks for resets, missions, orders.

import { $, Memory, clock, element, pill, say } from "./dom.js";
import { NO_TOKEN, protocols } from "./access.js";
import { Camera } from "./camera.js";
import { DecisionLog, EventLog, LINES } from "./log.js";
import { AirportMap } from "./map.js";
import { ProcessTable } from "./nodes.js";
import { Operating } from "./operate.js";
import { FaultTree, Order } from "./tree.js";

const LOGS = ["decisions", "events"];
const TABLES = ["lights"];   // of which the rows arrive that changed, null for one that is gone
const map = new AirportMap($("map"));
const tree = new FaultTree($("tree"));
const order = new Order($("order"));
const processes = new ProcessTable($("nodes"));
const logs = {
  decisions: new DecisionLog($("decisions"), "Nothing to decide so far."),
  events: new EventLog($("events"), "Nothing happened so far."),
};
const operating = new Operating((wish) => send(wish));
const camera = new Camera();
const memory = new Memory();
let picture = {};            // all that was heard, by section
let fresh = { decisions: [], events: [] };  // lines of the logs that are not shown yet
const changed = new Set();   // sections that are not shown yet
let frame = 0;
let notOnMap = {};           // what the map has not room for, and how many
let socket = null;           // null between two attempts
let retryMs = 500;
let lastHeard = 0;
let toastTimer = 0;

const SILENT_MS = 4000;      // the HMI speaks once a second at least
const OPENING_MS = 10000;

// ---- connection: reconnects by itself, and notices a server that only hangs -------------------

function connect() {
  lastHeard = Date.now();
  socket = new WebSocket(`ws://${location.host}/ws`, protocols());
  socket.onmessage = (event) => { lastHeard = Date.now(); receive(JSON.parse(event.data)); };
  socket.onclose = (event) => lost(
    event.code === NO_TOKEN ? "token missing: open the address that the run has printed, or #token=… with yours"
      : event.reason ? `closed by the HMI: ${event.reason}; reconnecting`
        : "HMI not reachable, reconnecting");
}

/** Take the connection for lost now: a browser waits a minute for a server that does not say goodbye. */
function lost(why) {
  socket.onclose = socket.onmessage = null;
  socket.close();
  socket = null;
  operating.offline();
  link("bad", why);
  setTimeout(connect, retryMs);
  retryMs = Math.min(retryMs * 1.5, 4000);
}

setInterval(() => {
  if (!socket) return;
  const patience = socket.readyState === WebSocket.OPEN ? SILENT_MS : OPENING_MS;
  if (Date.now() - lastHeard > patience) lost("HMI silent, reconnecting");
}, 1000);

const connected = () => socket !== null && socket.readyState === WebSocket.OPEN;

function link(kind, text) {
  pill("link", kind, text);
  document.body.classList.toggle("offline", kind === "bad");
}

function send(wish) {
  if (connected()) socket.send(JSON.stringify(wish));
  else toast("not connected");
}

function receive(message) {
  if (message.type === "hello") hello(message);
  else if (message.type === "state") take(message);
  else if (operating.receive(message)) return;
  else if (message.text) toast(message.text);
}

// ---- the picture: sections arrive when they changed, and are drawn with the next frame ----------

function take(message) {
  link("good", "live");
  for (const [name, value] of Object.entries(message)) {
    if (LOGS.includes(name)) fresh[name] = [...fresh[name], ...value].slice(-LINES);
    else if (TABLES.includes(name)) picture[name] = merged(picture[name], value);
    else picture[name] = value;
    changed.add(name);
  }
  if (document.hidden) seen();
  else if (!frame) frame = requestAnimationFrame(draw);
}

function merged(rows, news) {
  return new Map([...(rows || []), ...Object.entries(news)].filter(([name]) => news[name] !== null));
}

function draw() {
  frame = 0;
  if (!connected()) return;
  show(picture);
  changed.clear();
  seen();
}

/** Tell the HMI what was drawn: it sends the newest then, and never a backlog. */
function seen() {
  if (!connected() || picture.version === undefined) return;
  socket.send(`{"type":"seen","version":${picture.version}}`);
}

document.addEventListener("visibilitychange", () => {
  if (document.hidden) seen();
  else if (!frame) frame = requestAnimationFrame(draw);
});

function toast(text) {
  $("toast").textContent = text;
  $("toast").hidden = false;
  clearTimeout(toastTimer);
  toastTimer = setTimeout(() => { $("toast").hidden = true; }, 5000);
}

// ---- showing ----------------------------------------------------------------------------------

/** Begin a connection; of a robot, what the HMI does not tell is not offered. */
function hello(message) {
  retryMs = 500;
  $("map-panel").hidden = !("map" in message);
  $("mission-panel").hidden = !("missions" in message);
  picture = {};
  fresh = { decisions: [], events: [] };
  changed.clear();
  memory.forget();
  for (const log of Object.values(logs)) log.begin();
  map.begin(message.map || null, message.track || [], message.footprint_m);
  camera.begin(message.camera);
  system(null);
  notOnMap = message.left_out || {};
  leftOut({});
  $("airport").textContent = message.map ? message.map.name : "";
  $("rate").textContent = message.rate === 1 ? "" : `× ${message.rate}`;
  $("mission-name").replaceChildren(...(message.missions || []).map((name) => {
    const option = element("option", "", name);
    option.value = name;
    return option;
  }));
}

/** Parts of the page, each with the sections that it is made of. */
const PARTS = [
  [["operating"], (s) => { if (s.operating) operating.show(s.operating); }],
  [["pilot", "manager", "detections"], safety],
  [["mission", "control"], mission],
  [["mission"], (s) => orders(s.mission)],
  [["order"], (s) => told(s.order)],
  [["left_out"], (s) => leftOut(s.left_out)],
  [["pose"], (s) => where(s.pose)],
  [["lights"], (s) => lights(s.lights)],
  [["system"], (s) => system(s.system)],
  [["system", "manager", "detections"], (s) => {
    say($("tree-words"), tree.show(s.manager, s.detections));
    order.show(s.manager);
  }],
  [["nodes", "usage"], (s) => processes.show(s.nodes, s.usage)],
];

/** Show what changed. A part that fails, on values that nobody foresaw, does not take the others along. */
function show(s) {
  say($("clock"), clock(s.time_s));
  guarded(() => map.show(s, changed));
  for (const [sections, part] of PARTS) {
    if (sections.some((name) => changed.has(name))) guarded(() => part(s));
  }
  for (const name of LOGS) guarded(() => logs[name].add(fresh[name].splice(0)));
}

function guarded(part) {
  try {
    part();
  } catch (error) {
    reportError(error);
  }
}

function where(pose) {
  const { x_m: x, y_m: y, yaw_rad: yaw } = pose ? pose.value : {};
  const heading = (90 - yaw * 180 / Math.PI + 360) % 360;
  say($("where"), [x, y, yaw].every(Number.isFinite)
    ? `Robot at ${x.toFixed(1)} m east, ${y.toFixed(1)} m north, heading ${heading.toFixed(0).padStart(3, "0")}°${pose.stale ? " (not heard any more)" : ""}`
    : "The robot's pose is not known.");
}

/** Say what is not shown, because there is more of it than a page can hold. */
function leftOut(counts) {
  const missing = [...Object.entries(notOnMap), ...Object.entries(counts)];
  $("left-out").hidden = !missing.length;
  say($("left-out"), `Too much to show: ${missing.map(([what, n]) => `${n} of the ${what}`).join(", ")} left out.`);
}

function told(outcome) {
  if (memory.shown.order !== undefined && memory.shown.order !== outcome.number) toast(outcome.text);
  memory.shown.order = outcome.number;
}

function system(drawn) {
  $("tree-panel").hidden = !drawn || !(drawn.tree || drawn.note);
  $("order-panel").hidden = !drawn || !drawn.order;
  tree.begin(drawn && drawn.tree);
  order.begin(drawn && drawn.order);
  if (!drawn) return;
  say($("tree-title"), `Fault tree: ${drawn.title}`);
  say($("order-words"), `By ${drawn.criteria.join(", then ")}: what is above is preferred in doubt. ${drawn.note}`);
}

const PHASES = { running: "good", paused: "warn", "returning home": "warn", succeeded: "good", failed: "bad", cancelled: "bad", idle: "" };

function mission(s) {
  const m = s.mission;
  const idle = !m || !["running", "paused", "returning home"].includes(m.phase);
  $("start").hidden = !idle || !$("mission-name").options.length;
  if (!m) {
    pill("mission-phase", "warn", "Mission Manager not heard");
    $("mission-reason").textContent = "";
    $("steps").replaceChildren();
    $("mission-progress").hidden = true;
    return;
  }
  pill("mission-phase", m.stale ? "warn" : PHASES[m.phase], m.stale ? `${m.phase} (stale)` : m.phase);
  const waiting = s.control && s.control.value.phase === "waiting" && m.phase === "running";
  const name = m.name ? `Mission ${m.name}` : "No mission";
  $("mission-reason").textContent = [name, m.reason, waiting ? "waiting: obstacle ahead" : ""]
    .filter(Boolean).join(" · ");
  memory.once("steps", m, () => $("steps").replaceChildren(...m.goals.map((goal, i) => step(m, goal, i))));
  $("mission-progress").hidden = !m.goals.length;
  $("mission-progress").max = Math.max(m.goals.length, 1);
  $("mission-progress").value = m.phase === "succeeded" ? m.goals.length : m.step;
}

function step(m, goal, i) {
  const skipped = m.skipped.includes(i);
  const done = !skipped && (i < m.step || m.phase === "succeeded");
  const now = i === m.step && !done;
  const lost = now && (m.phase === "failed" || m.phase === "cancelled");
  const at = [goal.x_m, goal.y_m].map((m) => (Number.isFinite(m) ? m.toFixed(1) : "?")).join(", ");
  const line = element("li", done ? "done" : lost ? "failed" : now && m.phase !== "idle" ? "now" : "");
  if (line.className === "now") line.setAttribute("aria-current", "step");
  line.append(element("span", "n", done ? "✓" : lost ? "✕" : i + 1),
    element("span", "", `${goal.mode} to (${at})${skipped ? ", skipped" : ""}`),
    element("span", "time", done && m.times_s[i] !== undefined ? clock(m.times_s[i]) : ""));
  return line;
}

/** Offer the orders that the Mission Manager would obey now. */
function orders(m) {
  const possible = m && !m.stale ? m.orders : [];
  $("orders").hidden = !m || !["running", "paused", "returning home"].includes(m.phase);
  for (const button of $("orders").children) {
    button.disabled = !possible.includes(button.dataset.order);
    if (button.disabled) unsure(button);
  }
}

/** An order that cannot be taken back wants a second press within four seconds. */
function ask(button) {
  if ("sure" in button.dataset && !button.classList.contains("sure")) {
    button.dataset.label = button.textContent;
    button.style.minWidth = `${button.offsetWidth}px`;  // it stays under the pointer
    button.textContent = "Sure?";
    button.classList.add("sure");
    setTimeout(() => unsure(button), 4000);
    return;
  }
  unsure(button);
  send({ type: "order", action: button.dataset.order });
}

function unsure(button) {
  if (!button.classList.contains("sure")) return;
  button.classList.remove("sure");
  button.textContent = button.dataset.label;
}

function lights(measured) {
  const count = { ok: 0, dim: 0, out: 0 };
  for (const light of measured.values()) count[light.verdict] += 1;
  const all = count.ok + count.dim + count.out;
  $("light-count").textContent = all
    ? `${all} of ${map.lights.size} lights measured: ${count.ok} ok, ${count.dim} dim, ${count.out} out`
    : "";
}

function safety(s) {
  const pilot = s.pilot && s.pilot.value;
  $("pilot-mode").hidden = $("pilot-reason").hidden = s.pilot === undefined;
  if (!pilot) pill("pilot-mode", "warn", "Safety Pilot not heard");
  else if (s.pilot.stale) pill("pilot-mode", "warn", "Safety Pilot silent");
  else pill("pilot-mode", pilot.stopped ? "bad" : pilot.mode === "auto" ? "good" : "warn",
    pilot.stopped ? (pilot.mode === "stop" ? "stopped" : `${pilot.mode}, stopped`) : pilot.mode);
  $("pilot-reason").textContent = pilot ? pilot.reason || "Commands pass unchanged." : "";
  manager(s.manager);
  $("detections").replaceChildren(...s.detections.map((d) => {
    const chip = element("li", d.active ? "active" : d.stale ? "stale" : "", d.active ? `▲ ${d.name}` : d.name);
    const nodes = d.nodes.length ? ` (${d.nodes.join(", ")})` : "";
    chip.title = d.active ? `${d.reason}${nodes}` : d.stale ? "silent" : "idle";
    chip.append(element("span", "unseen", `: ${chip.title}`));
    return chip;
  }));
}

function manager(heard) {
  const m = heard && heard.value;
  const facts = [["Manager", !m ? "not heard" : heard.stale ? "silent" : "alive"]];
  if (m) {
    facts.push(["Strategy", m.strategy], ["Active", m.active.join(", ") || "none"],
      ["Activated", m.activated.join(", ") || "none"]);
    if (m.silent.length) facts.push(["Silent modules", m.silent.join(", ")]);
  }
  $("manager").replaceChildren(...facts.flatMap(([k, v]) => [element("dt", "", k), element("dd", "", v)]));
  const latched = m ? m.latched : [];
  const acting = m ? m.active.length + m.activated.length : 0;
  $("alarm").hidden = !latched.length && !acting;
  $("alarm").classList.toggle("mild", !latched.length);
  say($("alarm-title"), latched.length
    ? `${latched.join(", ")} latched: waits for your reset.` : acting
      ? m.activated.length ? `Recovery under way: ${m.activated.join(", ")}.` : "A fault is detected." : "");
  say($("alarm-text"), m && m.active.length ? `Active: ${m.active.join(", ")}.` : "");
  document.title = `${latched.length ? "⚠ stopped · " : acting ? "▲ recovery · " : ""}Rampart`;
  memory.once("latched", latched, () => $("resets").replaceChildren(...latched.map((name) => {
    const box = picture.system?.order?.boxes.find((shown) => shown.name === name);
    const title = box && box.title !== name ? `${box.title.toLowerCase()} (${name})` : name;
    const button = element("button", "", `Reset ${title}`);
    button.onclick = () => send({ type: "reset", recovery: name });
    return button;
  })));
}

for (const button of $("orders").children) button.addEventListener("click", () => ask(button));

$("start").addEventListener("submit", (event) => {
  event.preventDefault();
  send({ type: "mission", name: $("mission-name").value });
});

$("follow").addEventListener("click", () => {
  const on = $("follow").getAttribute("aria-pressed") !== "true";
  $("follow").setAttribute("aria-pressed", on);
  map.follow(on);
});

connect();

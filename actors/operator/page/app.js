// The operator's page: shows the picture that the HMI pushes, asks for what the operator wants.

import { $, Memory, clock, element, pill, say } from "./dom.js";
import { NOT_LOGGED_IN, Visitor, bar, barred } from "./access.js";
import { Arrangement } from "./arrange.js";
import { Camera } from "./camera.js";
import { DecisionLog, EventLog, LINES } from "./log.js";
import { Operating } from "./operate.js";
import { ProcessTable } from "./nodes.js";
import { Panels } from "./panels.js";
import { FaultTree, Order } from "./tree.js";

const LOGS = ["decisions", "events"];
const panels = new Panels(new Arrangement($("main")), { send, toast, bar, barred });
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
const visitor = new Visitor(connect, () => { if (socket) lost("logged out"); });
let picture = {};            // all that was received, by section
let fresh = { decisions: [], events: [] };  // lines of the logs that are not shown yet
const changed = new Set();   // sections that are not shown yet
let frame = 0;
let tables = [];             // sections of which the rows arrive that changed, null for one that is gone
let ready = false;           // whether the panels of this connection are there
let tooMuch = {};            // what the HMI had no room for when it began, and how many
let introduction = null;     // what the HMI offers this page: it comes before the panels are there
let socket = null;           // null between two attempts
let retryMs = 500;
let retry = 0;
let lastHeard = 0;
let toastTimer = 0;
let expires = null;          // the certificate of the run that expires first, and when
let badge = "";              // what the HMI calls this connection: live, or replay

const OLD_MS = 1700;         // the HMI sends a frame once a second at least
const SILENT_MS = 4000;
const OPENING_MS = 10000;

// ---- connection: reconnects by itself, and notices a server that only hangs -------------------

function connect() {
  lastHeard = Date.now();
  socket = new WebSocket(`${location.protocol.replace("http", "ws")}//${location.host}/ws`, "rampart");
  socket.onmessage = (event) => { lastHeard = Date.now(); receive(JSON.parse(event.data)); };
  socket.onclose = (event) => {
    if (event.code === NOT_LOGGED_IN) turnedAway(event.reason);
    else lost(event.reason ? `closed by the HMI: ${event.reason}; reconnecting` : "HMI not reachable, reconnecting");
  };
}

/** Wait for a token: what was shown last, if anything, opens nothing any more. */
function turnedAway(reason) {
  lost("not logged in");
  clearTimeout(retry);
  visitor.ask(`${reason[0].toUpperCase()}${reason.slice(1)}.`);
}

/** Take the connection for lost now: a browser waits a minute for a server that does not say goodbye. */
function lost(why) {
  socket.onclose = socket.onmessage = null;
  socket.close();
  socket = null;
  ready = false;
  panels.offline();
  link("bad", why);
  retry = setTimeout(connect, retryMs);
  retryMs = Math.min(retryMs * 1.5, 4000);
}

setInterval(() => {
  if (!socket) return;
  const silent = Date.now() - lastHeard;
  if (silent > (connected() ? SILENT_MS : OPENING_MS)) lost("HMI silent, reconnecting");
  else if (connected() && silent > OLD_MS) link("bad", "HMI silent");
}, 250);

const connected = () => socket !== null && socket.readyState === WebSocket.OPEN;

function link(kind, text) {
  pill("link", kind, text);
  document.body.classList.toggle("offline", kind === "bad");
  $("cut").hidden = kind !== "bad" || picture.time_s === undefined;
  say($("cut"), `Not connected. Every value below is old: it is of ${clock(picture.time_s)}.`);
}

function send(wish) {
  if (connected()) socket.send(JSON.stringify(wish));
  else toast("not connected");
}

function receive(message) {
  if (message.type === "hello") hello(message);
  else if (message.type === "state") take(message);
  else if (visitor.receive(message)) return;
  else if (operating.receive(message)) introduction = message;
  else if (panels.receive(message)) return;
  else if (message.text) toast(message.text);
}

// ---- the picture: sections arrive when they changed, and are drawn with the next frame ----------

function take(message) {
  link(badge === "live" ? "good" : "warn", badge);
  for (const [name, value] of Object.entries(message)) {
    if (LOGS.includes(name)) fresh[name] = [...fresh[name], ...value].slice(-LINES);
    else if (tables.includes(name)) picture[name] = merged(picture[name], value);
    else picture[name] = value;
    changed.add(name);
  }
  panels.take(message);
  soon();
}

/** Draw with the next frame; a page that is hidden has seen it, one that has no panels yet has not. */
function soon() {
  if (!ready) return;
  if (document.hidden) seen();
  else if (!frame) frame = requestAnimationFrame(draw);
}

function merged(rows, news) {
  return new Map([...(rows || []), ...Object.entries(news)].filter(([name]) => news[name] !== null));
}

function draw() {
  frame = 0;
  if (!connected() || !ready) return;
  show(picture);
  changed.clear();
  seen();
}

/** Tell the HMI what was drawn: it sends the newest then, and never a backlog. */
function seen() {
  if (!connected() || picture.version === undefined) return;
  socket.send(`{"type":"seen","version":${picture.version}}`);
}

document.addEventListener("visibilitychange", soon);

function toast(text) {
  $("toast").textContent = text;
  $("toast").hidden = false;
  clearTimeout(toastTimer);
  toastTimer = setTimeout(() => { $("toast").hidden = true; }, 5000);
}

// ---- showing ----------------------------------------------------------------------------------

/** Begin a connection; what the HMI does not announce is not offered. */
async function hello(message) {
  const from = socket;
  retryMs = 500;
  badge = message.badge;
  tables = message.tables;
  picture = {};
  fresh = { decisions: [], events: [] };
  changed.clear();
  memory.forget();
  for (const log of Object.values(logs)) log.begin();
  camera.begin(message.camera);
  system(null);
  tooMuch = message.left_out || {};
  leftOut({});
  say($("system"), message.system);
  expires = message.expires;
  $("rate").textContent = message.rate === 1 ? "" : `× ${message.rate}`;
  await panels.begin(message);
  if (socket !== from) return;  // lost meanwhile
  panels.receive(introduction);
  panels.take(picture);
  ready = true;
  soon();
}

/** Parts of the page, each with the sections that it is made of. */
const PARTS = [
  [["operating"], (s) => { if (s.operating) operating.show(s.operating); }],
  [["manager", "detections"], safety],
  [["order"], (s) => told(s.order)],
  [["left_out"], (s) => leftOut(s.left_out)],
  [["system"], (s) => system(s.system)],
  [["system", "manager", "detections"], (s) => {
    say($("tree-words"), tree.show(s.manager, s.detections));
    order.show(s.manager);
  }],
  [["nodes", "usage"], (s) => processes.show(s.nodes, s.usage)],
  [["usage"], credentials],
  [["behind"], (s) => {
    $("behind").hidden = !s.behind;
    say($("behind"), s.behind);
  }],
];

/** Show what changed. A part that fails on unexpected values does not affect the others. */
function show(s) {
  say($("clock"), clock(s.time_s));
  panels.show(s, changed);
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

/** Say what is not shown, because there is more of it than a page can hold. */
function leftOut(counts) {
  const missing = [...Object.entries(tooMuch), ...Object.entries(counts)];
  $("left-out").hidden = !missing.length;
  say($("left-out"), `Too much to show: ${missing.map(([what, n]) => `${n} of the ${what}`).join(", ")} left out.`);
}

/** Say for how many days the credentials of the run are still valid. */
function credentials() {
  $("credentials").hidden = !expires;
  if (!expires) return;
  const days = (expires[1] - Date.now() / 1000) / 86400;
  pill("credentials", days < 3 ? "bad" : days < 7 ? "warn" : "", `credentials: ${days < 0 ? "expired" : `${days.toFixed(days < 10 ? 1 : 0)} days left`}`);
  $("credentials").title = `The certificate of ${expires[0]} expires first, at ${new Date(1000 * expires[1]).toISOString()}.`;
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

function safety(s) {
  manager(s.manager);
  $("detections").replaceChildren(...s.detections.map((d) => {
    const silent = d.stale || s.manager?.value.silent.includes(d.name);
    const chip = element("li", d.active ? "active" : silent ? "stale" : "", `${d.active ? "▲ " : silent ? "? " : ""}${d.name}`);
    const nodes = d.nodes.length ? ` (${d.nodes.join(", ")})` : "";
    const state = d.active ? `${d.reason}${nodes}` : silent ? "not heard" : "idle";
    chip.title = `${named(d.name)}: ${state}`;
    chip.append(element("span", "unseen", `: ${state}`));
    return chip;
  }));
}

function named(name) {
  const title = picture.system?.titles?.[name];
  return title && title !== name ? `${title} (${name})` : name;
}

function manager(heard) {
  const m = heard && heard.value;
  const facts = [["Manager", !m ? "not heard" : heard.stale ? "silent" : "alive"]];
  if (m) {
    facts.push(["Strategy", m.strategy], ["Active", m.active.map(named).join(", ") || "none"],
      ["Activated", m.activated.map(named).join(", ") || "none"]);
    if (m.silent.length) facts.push(["Silent modules", m.silent.map(named).join(", ")]);
  }
  $("manager").replaceChildren(...facts.flatMap(([k, v]) => [element("dt", "", k), element("dd", "", v)]));
  const latched = m ? m.latched : [];
  const acting = m ? m.active.length + m.activated.length : 0;
  $("alarm").hidden = !latched.length && !acting;
  $("alarm").classList.toggle("mild", !latched.length);
  say($("alarm-title"), latched.length
    ? `${latched.map(named).join(", ")}: latched, waits for your reset.` : acting
      ? m.activated.length ? m.activated.map(named).join(", ") : "A fault is detected." : "");
  say($("alarm-text"), m && m.active.length ? `${m.active.map(named).join(", ")}.` : "");
  document.title = `${latched.length ? "⚠ stopped · " : acting ? "▲ recovery · " : ""}Rampart`;
  memory.once("latched", latched, () => $("resets").replaceChildren(...latched.map((name) => {
    const button = element("button", "", `Reset ${named(name)}`);
    button.onclick = () => send({ type: "reset", recovery: name });
    return button;
  })));
}

connect();

// The operator's page: draws the picture that the HMI pushes, and sends the operator's requests.

import { $, Memory, clock, element, pill, say } from "./dom.js";
import { NOT_LOGGED_IN, Visitor, bar, barred } from "./access.js";
import { Arrangement } from "./arrange.js";
import { DecisionLog, EventLog, LINES, showHistory } from "./log.js";
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
  decisions: new DecisionLog($("decisions"), "No decisions yet."),
  events: new EventLog($("events"), "No events yet."),
};
const operating = new Operating((wish) => send(wish));
const memory = new Memory();
const visitor = new Visitor(connect, () => { if (socket) lost("logged out"); });
let picture = {};            // latest value of each section
let fresh = { decisions: [], events: [] };  // lines of the logs that are not drawn yet
const changed = new Set();   // sections that are not drawn yet
let frame = 0;
let ready = false;           // whether the panels of this connection exist
let tooMuch = {};            // number of missing entries at the start of the connection
let introduction = null;     // the HMI's offer to this page: it comes before the panels exist
let socket = null;           // null between two attempts
let retryMs = 500;
let retry = 0;
let lastHeard = 0;
let toastTimer = 0;
let expires = null;          // the certificate of the run that expires first, and the time
let badge = "";              // kind of the connection: live, or replay

const OLD_MS = 1700;         // the HMI sends at least one frame per second
const SILENT_MS = 4000;
const OPENING_MS = 10000;

// ---- connection: reconnects by itself, also when the server hangs ------------------------------

function connect() {
  lastHeard = Date.now();
  socket = new WebSocket(`${location.protocol.replace("http", "ws")}//${location.host}/ws`, "rampart");
  socket.onmessage = (event) => { lastHeard = Date.now(); receive(JSON.parse(event.data)); };
  socket.onclose = (event) => {
    if (event.code === NOT_LOGGED_IN) turnedAway(event.reason);
    else lost(event.reason ? `closed by the HMI: ${event.reason}; reconnecting` : "HMI not reachable, reconnecting");
  };
}

/** Wait for a token: the last one, if any, is not valid any more. */
function turnedAway(reason) {
  lost("not logged in");
  clearTimeout(retry);
  visitor.ask(`${reason[0].toUpperCase()}${reason.slice(1)}.`);
}

/** Treat the connection as lost: a browser waits a minute for a server that does not close it. */
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
  say($("cut"), `Not connected. All values below are from ${clock(picture.time_s)}.`);
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

// ---- the picture: changed sections arrive, and are drawn with the next frame --------------------

function take(message) {
  link(badge === "live" ? "good" : "warn", badge);
  for (const [name, value] of Object.entries(message)) {
    if (LOGS.includes(name)) fresh[name] = [...fresh[name], ...value].slice(-LINES);
    else picture[name] = value;
    changed.add(name);
  }
  panels.take(message);
  soon();
}

/** Draw with the next frame; a hidden page reports at once that it has drawn. */
function soon() {
  if (!ready) return;
  if (document.hidden) seen();
  else if (!frame) frame = requestAnimationFrame(draw);
}

function draw() {
  frame = 0;
  if (!connected() || !ready) return;
  show(picture);
  changed.clear();
  seen();
}

/** Report the drawn version to the HMI, which then sends the newest one, and never a backlog. */
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

// ---- drawing ----------------------------------------------------------------------------------

/** Begin a connection; the page offers only what the HMI announces. */
async function hello(message) {
  const from = socket;
  retryMs = 500;
  badge = message.badge;
  picture = {};
  fresh = { decisions: [], events: [] };
  changed.clear();
  memory.forget();
  for (const log of Object.values(logs)) log.begin();
  system(null);
  tooMuch = message.left_out || {};
  leftOut({});
  say($("system"), message.system);
  expires = message.expires;
  $("rate").textContent = message.rate === 1 ? "" : `× ${message.rate}`;
  await panels.begin(message);
  if (socket !== from) return;  // lost in the meantime
  panels.receive(introduction);
  panels.take(picture);
  ready = true;
  soon();
}

/** Parts of the page, each with its sections. */
const PARTS = [
  [["operating"], (s) => { if (s.operating) operating.show(s.operating); }],
  [["manager"], (s) => safety(s.manager)],
  [["order"], (s) => told(s.order)],
  [["left_out"], (s) => leftOut(s.left_out)],
  [["system"], (s) => system(s.system)],
  [["system", "manager"], (s) => {
    say($("tree-words"), tree.show(s.manager));
    order.show(s.manager);
  }],
  [["nodes", "usage"], (s) => processes.show(s.nodes, s.usage)],
  [["usage"], credentials],
  [["history"], (s) => showHistory($("history"), $("history-panel"), s.history)],
  [["behind"], (s) => {
    $("behind").hidden = !s.behind;
    say($("behind"), s.behind);
  }],
];

/** Draw the changes. A part that fails on unexpected values does not affect the others. */
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

/** Show the number of entries that do not fit on the page. */
function leftOut(counts) {
  const missing = [...Object.entries(tooMuch), ...Object.entries(counts)];
  $("left-out").hidden = !missing.length;
  say($("left-out"), `Too much to show: ${missing.map(([what, n]) => `${n} of the ${what}`).join(", ")} left out.`);
}

/** Show the days of validity of the run's credentials. */
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
  say($("order-words"), `Ordered by ${drawn.criteria.join(", then ")}: upper recoveries are preferred. ${drawn.note}`);
}

function safety(heard) {
  manager(heard);
  $("detections").replaceChildren(...(heard?.value.detections ?? []).map((d) => {
    const silent = heard.stale || heard.value.silent.includes(d.name);
    const chip = element("li", d.active ? "active" : silent ? "stale" : "", `${d.active ? "▲ " : silent ? "? " : ""}${d.name}`);
    const nodes = d.nodes.length ? ` (${d.nodes.join(", ")})` : "";
    const state = d.active ? `${d.reason}${nodes}` : silent ? "silent" : "idle";
    chip.title = `${named(d.name)}: ${state}`;
    chip.append(element("span", "unseen", `: ${state}`));
    return chip;
  }));
}

function named(name) {
  const title = picture.system?.titles?.[name];
  return title && title !== name ? `${title} (${name})` : name;
}

/** How mechanisms or recoveries clear, in words. */
function clearing(names) {
  const words = picture.system?.clearing ?? {};
  return [...new Set(names)].filter((name) => words[name]).map((name) => `${name} ${words[name]}.`).join(" ");
}

function manager(heard) {
  const m = heard && heard.value;
  const facts = [["Manager", !m ? "no message yet" : heard.stale ? "silent" : "alive"]];
  if (m) {
    facts.push(["Strategy", m.strategy], ["Active", m.active.map(named).join(", ") || "none"],
      ["Activated", m.activated.map(named).join(", ") || "none"]);
    if (m.silent.length) facts.push(["Silent modules", m.silent.map(named).join(", ")]);
  }
  $("manager").replaceChildren(...facts.flatMap(([k, v]) => [element("dt", "", k), element("dd", "", v)]));
  const latched = m ? m.latched : [];
  const lasting = picture.system?.never_cleared ?? {};
  const resettable = latched.filter((name) => !(lasting[name] ?? []).some((mechanism) => m.active.includes(mechanism)));
  const acting = m ? m.active.length + m.activated.length : 0;
  $("alarm").hidden = !latched.length && !acting;
  $("alarm").classList.toggle("mild", !latched.length);
  say($("alarm-title"), latched.length
    ? `${latched.map(named).join(", ")}: latched${resettable.length ? " until you reset it" : ""}.` : acting
      ? m.activated.length ? m.activated.map(named).join(", ") : "A fault is detected." : "");
  say($("alarm-text"), acting
    ? `${m.active.map(named).join(", ")}${m.active.length ? ". " : ""}${clearing([...m.active, ...latched])}` : "");
  document.title = `${latched.length ? "⚠ stopped · " : acting ? "▲ recovery · " : ""}Rampart`;
  memory.once("resettable", resettable, () => $("resets").replaceChildren(...resettable.map((name) => {
    const button = element("button", "", `Reset ${named(name)}`);
    button.onclick = () => send({ type: "reset", recovery: name });
    return button;
  })));
}

connect();

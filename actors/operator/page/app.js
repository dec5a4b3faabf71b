// The operator's page: shows the states that the HMI pushes, asks for resets, missions, orders.

import { AirportMap } from "./map.js";

const $ = (id) => document.getElementById(id);
const map = new AirportMap($("map"));
const shown = {};
let socket = null;
let retryMs = 500;
let lastHeard = 0;
let toastTimer = 0;

// ---- connection: reconnects by itself, and notices a server that only hangs -------------------

function connect() {
  socket = new WebSocket(`ws://${location.host}/ws`);
  socket.onopen = () => { retryMs = 500; lastHeard = Date.now(); };
  socket.onmessage = (event) => { lastHeard = Date.now(); receive(JSON.parse(event.data)); };
  socket.onclose = () => {
    link("bad", "HMI not reachable, reconnecting");
    setTimeout(connect, retryMs);
    retryMs = Math.min(retryMs * 1.5, 4000);
  };
}

setInterval(() => {
  if (socket && socket.readyState === WebSocket.OPEN && Date.now() - lastHeard > 4000) socket.close();
}, 1000);

function link(kind, text) {
  $("link").className = `pill ${kind}`;
  $("link").textContent = text;
  document.body.classList.toggle("offline", kind === "bad");
}

function send(wish) {
  if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(wish));
  else toast("not connected");
}

function receive(message) {
  if (message.type === "hello") hello(message);
  else if (message.type === "state") state(message);
  else toast(message.text);
}

function toast(text) {
  $("toast").textContent = text;
  $("toast").hidden = false;
  clearTimeout(toastTimer);
  toastTimer = setTimeout(() => { $("toast").hidden = true; }, 5000);
}

// ---- showing ----------------------------------------------------------------------------------

function element(tag, className, text) {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
}

/** Rebuild a part of the page only if its data changed, so that it can be read and selected. */
function once(name, value, build) {
  const text = JSON.stringify(value);
  if (shown[name] === text) return;
  shown[name] = text;
  build();
}

function clock(seconds) {
  if (!Number.isFinite(seconds)) return "–";
  const minutes = Math.floor(seconds / 60);
  return `${minutes}:${(seconds - 60 * minutes).toFixed(1).padStart(4, "0")}`;
}

function pill(id, kind, text) {
  $(id).className = `pill ${kind}`;
  $(id).textContent = text;
}

function hello(message) {
  for (const key of Object.keys(shown)) delete shown[key];
  map.begin(message.map, message.track);
  $("airport").textContent = message.map ? message.map.name : "";
  $("rate").textContent = message.rate === 1 ? "" : `× ${message.rate}`;
  $("mission-name").replaceChildren(...message.missions.map((name) => {
    const option = element("option", "", name);
    option.value = name;
    return option;
  }));
  document.title = message.map ? `Rampart · ${message.map.name}` : "Rampart";
}

function state(s) {
  link("good", "live");
  $("clock").textContent = clock(s.time_s);
  map.show(s);
  once("mission", [s.mission, s.control && s.control.value.phase], () => mission(s));
  orders(s.mission);
  if (shown.order !== undefined && shown.order !== s.order.number) toast(s.order.text);
  shown.order = s.order.number;
  once("lights", s.lights, () => lights(s.lights));
  once("safety", [s.pilot, s.manager, s.detections], () => safety(s));
  once("nodes", s.nodes, () => nodes(s.nodes));
  once("decisions", s.decisions, () => decisions(s.decisions));
  once("events", s.events, () => events(s.events));
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
    return;
  }
  pill("mission-phase", m.stale ? "warn" : PHASES[m.phase], m.stale ? `${m.phase} (stale)` : m.phase);
  const waiting = s.control && s.control.value.phase === "waiting" && m.phase === "running";
  const name = m.name ? `Mission ${m.name}` : "No mission";
  $("mission-reason").textContent = [name, m.reason, waiting ? "waiting: obstacle ahead" : ""]
    .filter(Boolean).join(" · ");
  $("steps").replaceChildren(...m.goals.map((goal, i) => step(m, goal, i)));
}

function step(m, goal, i) {
  const skipped = m.skipped.includes(i);
  const done = !skipped && (i < m.step || m.phase === "succeeded");
  const now = i === m.step && !done;
  const lost = now && (m.phase === "failed" || m.phase === "cancelled");
  const line = element("li", done ? "done" : lost ? "failed": now && m.phase !== "idle" ? "now" : "");
  line.append(element("span", "n", done ? "✓" : lost ? "✕" : i + 1),
    element("span", "", `${goal.mode} to (${goal.x_m.toFixed(1)}, ${goal.y_m.toFixed(1)})${skipped ? ", skipped" : ""}`),
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
  for (const light of Object.values(measured)) count[light.verdict] += 1;
  const all = count.ok + count.dim + count.out;
  $("light-count").textContent = all
    ? `${all} of ${map.lights.size} lights measured: ${count.ok} ok, ${count.dim} dim, ${count.out} out`
    : "";
}

function safety(s) {
  const pilot = s.pilot && s.pilot.value;
  if (!pilot) pill("pilot-mode", "warn", "Safety Pilot not heard");
  else if (s.pilot.stale) pill("pilot-mode", "warn", "Safety Pilot silent");
  else pill("pilot-mode", pilot.stopped ? "bad" : pilot.mode === "auto" ? "good" : "warn",
    pilot.stopped ? (pilot.mode === "stop" ? "stopped" : `${pilot.mode}, stopped`) : pilot.mode);
  $("pilot-reason").textContent = pilot ? pilot.reason || "Commands pass unchanged." : "";
  manager(s.manager);
  $("detections").replaceChildren(...s.detections.map((d) => {
    const chip = element("li", d.active ? "active" : d.stale ? "stale" : "", d.name);
    const nodes = d.nodes.length ? ` (${d.nodes.join(", ")})` : "";
    chip.title = d.active ? `${d.reason}${nodes}` : d.stale ? "silent" : "idle";
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
  $("alarm-title").textContent = latched.length
    ? `${latched.join(", ")} latched: waits for your reset.` : "A recovery is under way.";
  $("alarm-text").textContent = m && m.active.length ? `Active: ${m.active.join(", ")}.` : "";
  once("latched", latched, () => $("resets").replaceChildren(...latched.map((name) => {
    const button = element("button", "", name === "RM1" ? "Reset emergency stop (RM1)" : `Reset ${name}`);
    button.onclick = () => send({ type: "reset", recovery: name });
    return button;
  })));
}

const STATES = { running: "good", starting: "warn", stopped: "bad", wedged: "bad", crashed: "bad", "given up": "bad" };

function nodes(heard) {
  const troubled = (n) => (n.state === "running" ? 1 : 0);
  const rows = heard ? heard.value.nodes.slice().sort((a, b) => troubled(a) - troubled(b)) : [];
  const up = rows.filter((n) => n.state === "running").length;
  $("nodes-count").textContent = heard ? `${up} of ${rows.length} running${heard.stale ? " · supervisor silent" : ""}` : "supervisor not heard";
  $("nodes").replaceChildren(...rows.map((n) => {
    const row = element("tr");
    row.title = `${n.kind}, incarnation ${n.incarnation}`;
    const stateCell = element("td");
    stateCell.append(element("span", `dot ${STATES[n.state] || ""}`), n.state);
    row.append(element("td", "", n.name), element("td", "quiet", n.kind), stateCell,
      element("td", "num", n.pid || "–"), element("td", "num", n.restarts));
    return row;
  }));
}

function logLine(seconds, kind, text) {
  const line = element("li");
  line.append(element("time", "", clock(seconds)), element("p", kind, text));
  return line;
}

function decisions(list) {
  $("decisions").replaceChildren(...list.slice().reverse().map((d) => {
    const line = logLine(d.t, "", d.words);
    const why = [...d.path.map((p) => `path: ${p}`), ...d.rejected.map((r) => `rejected: ${r}`)];
    if (why.length) {
      const details = element("details");
      const items = element("ul");
      items.append(...why.map((text) => element("li", "", text)));
      details.append(element("summary", "", `certificate of decision ${d.number}`), items);
      line.append(details);
    }
    return line;
  }));
  if (!list.length) $("decisions").append(element("li", "empty", "Nothing to decide so far."));
}

function events(list) {
  $("events").replaceChildren(...list.slice().reverse().map((e) => logLine(e.t, e.kind, e.text)));
  if (!list.length) $("events").append(element("li", "empty", "Nothing happened so far."));
}

for (const button of $("orders").children) button.addEventListener("click", () => ask(button));

$("start").addEventListener("submit", (event) => {
  event.preventDefault();
  send({ type: "mission", name: $("mission-name").value });
});

connect();

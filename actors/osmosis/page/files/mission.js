// The mission: goals, progress, orders, start, and the number of measured lights.

import { Memory, clock, element, pill, say } from "../dom.js";

const PHASES = { running: "good", paused: "warn", "returning home": "warn", succeeded: "good", failed: "bad", cancelled: "bad", idle: "" };
const UNDER_WAY = ["running", "paused", "returning home"];
const ORDERS = [["pause", "Pause"], ["resume", "Resume"], ["skip", "Skip goal", true], ["home", "Home", true], ["cancel", "Cancel", true]];

const named = (tag, id, className, text) => Object.assign(element(tag, className, text), { id });

export default class Mission {
  constructor(room, page) {
    this.send = page.send;
    this.memory = new Memory();
    this.phase = named("span", "mission-phase", "pill");
    room.title.append(" ", this.phase);
    this.reason = named("p", "mission-reason", "quiet");
    this.progress = named("progress", "mission-progress");
    this.progress.setAttribute("aria-label", "Goals reached");
    this.steps = named("ol", "steps", "steps");
    this.count = named("p", "light-count", "quiet");
    this.orders = named("div", "orders", "row");
    this.orders.setAttribute("role", "group");
    this.orders.setAttribute("aria-label", "Orders to the mission");
    this.orders.append(...ORDERS.map(([order, text, sure]) => {
      const button = element("button", "", text);
      button.type = "button";
      button.dataset.order = order;
      if (sure) button.dataset.sure = "";
      button.addEventListener("click", () => this.ask(button));
      return button;
    }));
    this.start = named("form", "start", "row");
    const label = element("label", "quiet", "Start");
    label.htmlFor = "mission-name";
    this.choice = named("select", "mission-name");
    const submit = element("button", "", "Start mission");
    this.start.append(label, this.choice, submit);
    this.start.addEventListener("submit", (event) => {
      event.preventDefault();
      this.send({ type: "mission", name: this.choice.value });
    });
    this.hands = element("div");
    this.hands.append(this.orders, this.start);
    this.bar = () => page.bar(this.hands, "order");
    room.body.append(this.reason, this.progress, this.steps, this.count, this.hands);
  }

  begin(hello) {
    this.bar();
    this.memory.forget();
    this.lights = hello.map ? hello.map.lights.length : 0;
    this.choice.replaceChildren(...(hello.missions || []).map((name) => new Option(name, name)));
    this.show({ lights: {} }, new Set(["mission", "lights"]));
  }

  show(s, changed) {
    if (changed.has("mission") || changed.has("control")) this.mission(s.mission, s.control);
    if (changed.has("mission")) this.offer(s.mission);
    if (changed.has("lights")) this.measured(s.lights);
  }

  mission(m, control) {
    this.start.hidden = (m && UNDER_WAY.includes(m.phase)) || !this.choice.options.length;
    if (!m) {
      pill(this.phase, "warn", "Mission Manager silent");
      say(this.reason, "");
      this.steps.replaceChildren();
      this.progress.hidden = true;
      return;
    }
    pill(this.phase, m.stale ? "warn" : PHASES[m.phase], m.stale ? `${m.phase} (stale)` : m.phase);
    const waiting = control && control.value.phase === "waiting" && m.phase === "running";
    const name = m.name ? `Mission ${m.name}` : "No mission";
    say(this.reason, [name, m.reason, waiting ? "waiting: obstacle ahead" : ""].filter(Boolean).join(" · "));
    this.memory.once("steps", m, () => this.steps.replaceChildren(...m.goals.map((goal, i) => step(m, goal, i))));
    this.progress.hidden = !m.goals.length;
    this.progress.max = Math.max(m.goals.length, 1);
    this.progress.value = m.phase === "succeeded" ? m.goals.length : m.step;
  }

  /** Offer the orders that the Mission Manager would obey now. */
  offer(m) {
    const possible = m && !m.stale ? m.orders : [];
    this.orders.hidden = !m || !UNDER_WAY.includes(m.phase);
    for (const button of this.orders.children) {
      button.disabled = !possible.includes(button.dataset.order);
      if (button.disabled) unsure(button);
    }
  }

  /** An order that cannot be taken back wants a second press within four seconds. */
  ask(button) {
    if ("sure" in button.dataset && !button.classList.contains("sure")) {
      button.dataset.label = button.textContent;
      button.style.minWidth = `${button.offsetWidth}px`;  // keeps its size under the pointer
      button.textContent = "Sure?";
      button.classList.add("sure");
      setTimeout(() => unsure(button), 4000);
      return;
    }
    unsure(button);
    this.send({ type: "order", action: button.dataset.order });
  }

  measured(rows) {
    const count = { ok: 0, dim: 0, out: 0 };
    for (const light of Object.values(rows)) count[light.verdict] += 1;
    const all = count.ok + count.dim + count.out;
    say(this.count, all
      ? `${all} of ${this.lights} lights measured: ${count.ok} ok, ${count.dim} dim, ${count.out} out`
      : "");
  }
}

function unsure(button) {
  if (!button.classList.contains("sure")) return;
  button.classList.remove("sure");
  button.textContent = button.dataset.label;
}

function step(m, goal, i) {
  const skipped = m.skipped.includes(i);
  const done = !skipped && (i < m.step || m.phase === "succeeded");
  const now = i === m.step && !done;
  const lost = now && (m.phase === "failed" || m.phase === "cancelled");
  const at = [goal.x_m, goal.y_m].map((v) => (Number.isFinite(v) ? v.toFixed(1) : "?")).join(", ");
  const line = element("li", done ? "done" : lost ? "failed" : now && m.phase !== "idle" ? "now" : "");
  if (line.className === "now") line.setAttribute("aria-current", "step");
  line.append(element("span", "n", done ? "✓" : lost ? "✕" : i + 1),
    element("span", "", `${goal.mode} to (${at})${skipped ? ", skipped" : ""}`),
    element("span", "time", done && m.times_s[i] !== undefined ? clock(m.times_s[i]) : ""));
  return line;
}

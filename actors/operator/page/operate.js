// Actions on every page: choose the strategy, signal processes, inject faults.

import { $, element, say } from "./dom.js";

const SIGNALS = {
  KILL: "the process ends at once",
  STOP: "the process is suspended until CONT",
  CONT: "a suspended process continues",
  TERM: "the process exits cleanly; its supervisor treats that as a crash",
  SEGV: "the process ends as after an invalid memory access",
  WEDGE: "the process runs, but its event loop is blocked",
};
const GROUPS = { paper: "The paper's", sensor: "Sensors", actuator: "Actuators" };
const WAYS = {
  drop: "nothing arrives", freeze: "the last message is repeated with its old stamp",
  stuck: "the last content is repeated with fresh stamps", delay: "every message is late",
  duplicate: "every message arrives twice", restamp: "every stamp is half a second ahead",
};

/** A button in a node's row that opens the dialog of its signals. */
export function signalButton(node) {
  const button = element("button", "small signal", "⋯");
  button.type = "button";
  button.dataset.signal = node;
  button.setAttribute("aria-label", `Signals to ${node}`);
  button.setAttribute("aria-haspopup", "dialog");
  return button;
}

export class Operating {
  constructor(send) {
    this.send = send;
    this.known = new Map();
    this.node = "";
    this.signal = "";
    this.ownDuration = 10;
    this.lines = new Map();
    this.current = "";  // strategy
    $("strategy").addEventListener("submit", (event) => {
      event.preventDefault();
      send({ type: "strategy", name: $("strategy-name").value });
    });
    document.addEventListener("click", (event) => {
      const button = event.target.closest?.("button[data-signal]");
      if (button) this.open(button.dataset.signal);
    });
    $("signal-confirm").addEventListener("click", () => {
      this.send({ type: "signal", node: this.node, signal: this.signal });
      $("signal-dialog").close();
    });
    $("signal-cancel").addEventListener("click", () => $("signal-dialog").close());
    $("fault").addEventListener("change", () => this.describe());
    $("fault-permanent").addEventListener("change", () => this.describe());
    $("inject").addEventListener("submit", (event) => {
      event.preventDefault();
      this.inject();
    });
  }

  /** Take a message from the HMI; return whether it was for this part of the page. */
  receive(message) {
    if (message.type !== "operating") return false;
    $("strategy-name").replaceChildren(...message.strategies.map((name) => new Option(name, name)));
    this.current = "";
    this.signals = message.signals;
    this.ownDuration = message.duration_s;
    this.known = new Map(message.faults.map((fault) => [fault.name, fault]));
    const groups = new Map();
    for (const fault of message.faults) {
      if (!groups.has(fault.group)) groups.set(fault.group, []);
      groups.get(fault.group).push([fault.name, fault.name]);
    }
    const choices = [...groups].map(([group, options]) => this.group(GROUPS[group] || group, options));
    choices.push(this.group("Any topic", message.modes.map((mode) => [`${mode}:`, `${mode} a topic`])));
    const before = $("fault").value;
    $("fault").replaceChildren(...choices);
    if (before) $("fault").value = before;
    $("fault-topic").replaceChildren(...message.topics.map((key) => new Option(key, key)));
    this.describe();
    return true;
  }

  group(label, options) {
    const made = element("optgroup");
    made.label = label;
    made.append(...options.map(([value, text]) => new Option(text, value)));
    return made;
  }

  describe() {
    const chosen = $("fault").value;
    const mode = chosen.endsWith(":") ? chosen.slice(0, -1) : "";
    const fault = this.known.get(chosen);
    $("fault-topic").parentElement.hidden = !mode;
    $("fault-duration").placeholder = fault ? fault.duration_s ?? "permanent" : this.ownDuration;
    $("fault-duration").disabled = $("fault-permanent").checked;
    say($("fault-title"), fault ? fault.title : WAYS[mode] || "");
  }

  inject() {
    const chosen = $("fault").value;
    const wish = { type: "inject", fault: chosen.endsWith(":") ? chosen + $("fault-topic").value : chosen };
    const duration = $("fault-duration").valueAsNumber;
    if ($("fault-permanent").checked) wish.permanent = true;
    else if (Number.isFinite(duration)) wish.duration_s = duration;
    this.send(wish);
  }

  open(node) {
    this.node = node;
    this.choose("");
    say($("signal-node"), node);
    $("signals").replaceChildren(...(this.signals || []).map((name) => {
      const button = element("button", "", name);
      button.type = "button";
      button.title = SIGNALS[name] || "";
      button.addEventListener("click", () => this.choose(name));
      return button;
    }));
    $("signal-dialog").showModal();
  }

  /** A signal cannot be undone, so it is chosen first, and a second button sends it. */
  choose(name) {
    this.signal = name;
    for (const button of $("signals").children) {
      button.setAttribute("aria-pressed", String(button.textContent === name));
    }
    say($("signal-what"), name ? SIGNALS[name] || "" : "Choose a signal.");
    $("signal-confirm").hidden = !name;
    $("signal-confirm").textContent = `Send ${name} to ${this.node}`;
    if (name) $("signal-confirm").focus();
  }

  /** Lines stay and only their texts change, so a button keeps its focus and its click. */
  show(operating) {
    const { strategy } = operating;
    say($("strategy-now"), strategy ? `in force: ${strategy}` : "no message from the FTM Manager yet");
    $("strategy-set").disabled = operating.strategy_asked || !strategy;
    if (strategy && strategy !== this.current) this.current = $("strategy-name").value = strategy;
    const there = new Set(operating.faults.map((fault) => fault.injection));
    for (const [injection, { line }] of this.lines) {
      if (!there.has(injection)) { line.remove(); this.lines.delete(injection); }
    }
    for (const fault of [...operating.faults].reverse()) {  // the newest is the first of the list
      const { text, button } = this.lines.get(fault.injection) || this.add(fault);
      text.className = fault.ended && !fault.effective ? "fault" : "";
      say(text, `${fault.fault}: ${fault.state}`);
      button.hidden = fault.ended;
    }
  }

  add(fault) {
    const made = { line: element("li"), text: element("p"), button: element("button", "small", "End") };
    made.button.type = "button";
    made.button.setAttribute("aria-label", `End ${fault.fault}`);
    made.button.addEventListener("click", () => this.send({ type: "end-fault", injection: fault.injection }));
    made.line.append(made.text, made.button);
    $("faults").prepend(made.line);
    this.lines.set(fault.injection, made);
    return made;
  }
}

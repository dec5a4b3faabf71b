// The decision log with the certificates of decisions, and the event log. The newest line is on top.
// Only new lines are added, so an open certificate stays open. And the history of faults over all runs.

import { clock, element } from "./dom.js";

export const LINES = 60;

class Log {
  constructor(list, empty) {
    this.list = list;
    this.empty = empty;
    this.begin();
  }

  begin() {
    this.list.replaceChildren(element("li", "empty", this.empty));
  }

  /** Add lines, the oldest first, as the HMI sends them. */
  add(lines) {
    if (!lines.length) return;
    this.list.querySelector(".empty")?.remove();
    for (const line of lines) this.list.prepend(this.line(line));
    while (this.list.children.length > LINES) this.list.lastChild.remove();
  }
}

export class EventLog extends Log {
  line(entry) {
    const line = element("li");
    const kind = { fault: "fault", clear: "clear" }[entry.kind] || "";
    const text = element("p", kind, entry.text);
    if (kind) text.prepend(element("span", "sign", kind === "fault" ? "▲ " : "✓ "));
    line.append(element("time", "", clock(entry.t)), text);
    return line;
  }
}

export class DecisionLog extends Log {
  line(d) {
    const line = element("li");
    const head = element("p", "chosen");
    head.append(...d.active.map((name) => element("b", "chip lit", name)),
      element("span", "arrow", d.active.length ? "→" : ""),
      ...(d.recoveries.length ? d.recoveries.map((name) => element("b", "chip go", name))
        : [element("b", "chip", "no recovery")]));
    line.append(element("time", "", clock(d.t)), head, element("p", "", d.words));
    const details = element("details");
    const facts = element("dl", "facts");
    const fact = (name, ...values) => facts.append(element("dt", "", name),
      ...values.map((value) => element("dd", "", value)));
    fact("Rule", d.rule);
    fact("Path", ...(d.path.length ? d.path : ["no comparison needed"]));
    fact("Rejected", ...(d.rejected.length ? d.rejected : ["no alternative"]));
    details.append(element("summary", "", `Certificate of decision ${d.number}`), facts);
    line.append(details);
    return line;
  }
}

const FAULT_DOTS = { suspected: "warn", confirmed: "bad", healed: "good", cleared: "" };

/** Show the faults of all runs; the panel is hidden while there are none. */
export function showHistory(body, panel, faults) {
  panel.hidden = !faults.length;
  body.replaceChildren(...faults.map((fault) => {
    const line = element("tr");
    const name = element("th", "", fault.mechanism);
    name.scope = "row";
    const state = element("td");
    state.append(element("span", `dot ${FAULT_DOTS[fault.state]}`), element("span", "", fault.state));
    line.append(name, element("td", "", fault.node), state, element("td", "num", String(fault.times)),
      element("td", "quiet", new Date(1000 * fault.last_s).toLocaleString()), element("td", "quiet", fault.error));
    return line;
  }));
}

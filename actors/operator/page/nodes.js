// The table of processes: state, age, restarts, processor and memory. Rows stay in place and only
// their texts change, so a focused button keeps the focus.

import { $, element, say } from "./dom.js";
import { signalButton } from "./operate.js";

const STATES = { running: "good", starting: "warn", stopped: "bad", wedged: "bad", crashed: "bad", "given up": "bad" };
const COLUMNS = ["state", "pid", "age", "restarts", "cpu", "mb"];

function age(seconds) {
  if (seconds === undefined) return "–";
  if (seconds < 100) return `${seconds} s`;
  return seconds < 6000 ? `${Math.round(seconds / 60)} min` : `${(seconds / 3600).toFixed(1)} h`;
}

export class ProcessTable {
  constructor(body) {
    this.body = body;
    this.rows = new Map();
  }

  show(heard, usage) {
    const guards = usage && usage.guards ? usage.guards : [];
    const nodes = heard ? heard.value.nodes : [];
    const all = [...nodes, ...guards];
    this.count(heard, all);
    const trouble = (n) => (n.state === "running" && !n.failing ? 1 : 0);
    const sorted = all.map((node, i) => [node, i]).sort(([a, i], [b, j]) => trouble(a) - trouble(b) || i - j);
    const names = new Set(all.map((node) => node.name));
    for (const [name, row] of this.rows) {
      if (!names.has(name)) { row.line.remove(); this.rows.delete(name); }
    }
    sorted.forEach(([node], i) => {
      const row = this.rows.get(node.name) || this.add(node);
      const there = this.body.children[i];
      if (there !== row.line) {  // move only the row that is out of place: it loses the focus
        if (this.body.children[i + 1] === row.line) this.body.append(there);
        else this.body.insertBefore(row.line, there || null);
      }
      const used = usage && usage.nodes && Object.hasOwn(usage.nodes, node.name) ? usage.nodes[node.name] : undefined;
      row.dot.className = `dot ${node.failing ? "bad" : STATES[node.state] || ""}`;
      row.line.classList.toggle("troubled", node.state !== "running" || Boolean(node.failing));
      row.line.title = `${node.kind}, incarnation ${node.incarnation}`;
      const next = node.next_attempt_s ? ` until ${node.next_attempt_s.toFixed(0)} s` : "";
      say(row.state, (node.failing ? "unstable" : node.state) + next);
      say(row.pid, node.pid ? String(node.pid) : "–");
      say(row.restarts, String(node.restarts));
      say(row.age, age(used?.age_s));
      say(row.cpu, used ? used.cpu.toFixed(1) : "–");
      say(row.mb, used ? used.mb.toFixed(0) : "–");
      row.bar.style.setProperty("--share", used ? Math.min(used.cpu / 100, 1) : 0);
    });
  }

  count(heard, all) {
    const up = all.filter((n) => n.state === "running").length;
    say($("nodes-count"), heard ? `${up} of ${all.length} running${heard.stale ? " · supervisor silent" : ""}` : "no message from the supervisor yet");
  }

  add(node) {
    const line = element("tr");
    line.dataset.node = node.name;
    const name = element("th", "", node.name);
    name.scope = "row";
    if (node.signals !== false) name.append(signalButton(node.name));
    line.append(name, element("td", "quiet kind", node.kind));
    const row = { line };
    for (const column of COLUMNS) {
      const cell = element("td", column === "state" ? "" : `num ${column}`);
      row[column] = element("span");
      if (column === "state") cell.append(row.dot = element("span", "dot"));
      cell.append(row[column]);
      line.append(cell);
      if (column === "cpu") row.bar = cell;
    }
    this.rows.set(node.name, row);
    return row;
  }
}

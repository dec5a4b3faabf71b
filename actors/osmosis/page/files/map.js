// The airport's map as SVG: metres, y flipped so that north is up.
//
// Ground, obstacles, sweeps and the robot's body have their true size. Marks (lights, nodes, goals, the
// robot's ring) and lines have a constant size on the screen: CSS scales `.mark` by `--mark`, the metres
// of a mark's unit, and `.dot` by `--dot`, which is smaller where many of them are close together.

import { Memory, element, say, svg as make } from "../dom.js";
import { View } from "../view.js";

const FOLLOW_M = 22;  // area around the robot when the map begins to follow it
const MARK_PX = 9;   // size of a mark's unit on the screen
const DOT = .25;      // least relative size of a dot
const TRACK_STEP_M = .25;
const TRACK_POINTS = 6000;

function points(list) {
  return list.map(([x, y]) => `${x},${-y}`).join(" ");
}

const finite = (pose) => [pose.x_m, pose.y_m, pose.yaw_rad].every(Number.isFinite);

class AirportMap {
  constructor(svg) {
    this.svg = svg;
    this.lights = new Map();
    this.track = [];
    this.memory = new Memory();
    this.onLook = () => {};
    this.view = new View(svg, (width, height) => this.scale(width, height));
  }

  /** Draw what does not move; `map` is an AirportDrawing or null, `track` the way driven so far,
   * `footprint` the robot's length and width or null. */
  begin(map, track, footprint) {
    this.svg.replaceChildren();
    this.lights.clear();
    this.memory.forget();
    this.view.at = null;
    const bounds = map ? map.bounds_m : [-50, -50, 50, 50];
    if (String(bounds) !== String(this.view.bounds)) this.view.seen = null;  // else a connection has come back
    this.view.bounds = bounds;
    const hatch = this.hatch = make("pattern", { id: "hatch", width: 1, height: 1,
      patternUnits: "userSpaceOnUse" }, make("defs", {}, this.svg));
    make("rect", { class: "hatch-ground", width: 1, height: 1 }, hatch);
    make("line", { class: "hatch-line", y2: 1 }, hatch);
    const ground = make("g", { transform: "scale(1,-1)" }, this.svg);
    if (map) this.drawGround(map, ground);
    this.edges = make("g", {}, this.svg);
    for (const [ax, ay, bx, by] of map ? map.edges : []) {
      make("line", { class: "edge", x1: ax, y1: -ay, x2: bx, y2: -by }, this.edges);
    }
    for (const [name, [x, y]] of Object.entries(map ? map.nodes : {})) {
      make("title", {}, make("circle", { class: "node", r: .28 }, this.mark(x, y, this.edges, "dot")), name);
    }
    this.route = make("polyline", { class: "route" }, this.svg);
    this.trackLine = make("polyline", { class: "track" }, this.svg);
    this.goals = make("g", {}, this.svg);
    this.lightLayer = make("g", {}, this.svg);
    for (const light of map ? map.lights : []) this.addLight(light);
    this.obstacles = make("g", {}, this.svg);
    this.robot = make("g", { class: "robot", visibility: "hidden" }, this.svg);
    this.sweeps = { laser: this.addSweep("lower"), upper_laser: this.addSweep("upper") };
    const ring = make("g", { class: "mark" }, this.robot);
    make("circle", { class: "robot-ring", r: 1.7 }, ring);
    make("path", { class: "robot-heading", d: "M1.7 0L2.7 0M2.35 -.3L2.75 0L2.35 .3" }, ring);
    const [length, width] = footprint || [.72, .614];
    make("rect", { class: "robot-body", x: -length / 2, y: -width / 2, width: length, height: width, rx: .1 }, this.robot);
    make("path", { class: "robot-front", d: `M${length / 2 - .2} ${-width / 2 + .1}L${length / 2 - .05} 0L${length / 2 - .2} ${width / 2 - .1}Z` }, this.robot);
    this.view.look();
    this.track = track.filter((p) => p.every(Number.isFinite));
    this.trackLine.setAttribute("points", points(this.track));
  }

  drawGround(map, ground) {
    // Pavement first: the prohibited area then covers the parts that it forbids.
    for (const [kind, path] of map.surfaces) make("path", { class: `pavement ${kind}`, d: path }, ground);
    make("path", { class: "prohibited-area", d: map.prohibited, "fill-rule": "evenodd" }, ground);
    for (const [name, path] of map.buildings) {
      make("title", {}, make("path", { class: "building", d: path }, ground), name);
    }
  }

  /** Return a group whose content keeps its size on the screen; its unit is that of a mark. */
  mark(x, y, parent, kind = "mark") {
    return make("g", { class: kind }, make("g", { transform: `translate(${x} ${-y})` }, parent));
  }

  addLight(light) {
    const group = this.mark(light.x_m, light.y_m, this.lightLayer, "dot");
    const dot = make("circle", { class: "light none", r: .55 }, group);
    const cross = make("path", { class: "cross", d: "M-.8 -.8L.8 .8M.8 -.8L-.8 .8", visibility: "hidden" }, group);
    const title = make("title", {}, group, `${light.name}: not measured`);
    this.lights.set(light.name, { dot, cross, title, verdict: "none" });
  }

  addSweep(which) {
    const group = make("g", { class: `sweep ${which}` }, this.robot);
    return { area: make("path", { class: "sweep-area" }, group), echoes: make("path", { class: "sweep-echoes" }, group) };
  }

  /** Give marks and lines their size on the screen. */
  scale(width, height) {
    const mark = MARK_PX * Math.max(width / (this.svg.clientWidth || 1), height / (this.svg.clientHeight || 1));
    this.svg.style.setProperty("--mark", mark);
    this.svg.style.setProperty("--dot", Math.min(mark, Math.max(mark * DOT, 1)));
    this.hatch?.setAttribute("patternTransform", `rotate(45) scale(${mark})`);
    this.onLook();
  }

  /** Show what changed of a picture; `changed` is the set of the names of its sections. */
  show(picture, changed) {
    if (changed.has("pose") || changed.has("pilot")) this.showRobot(picture.pose, picture.pilot);
    for (const which of ["laser", "upper_laser"]) {
      if (changed.has(which)) this.showSweep(this.sweeps[which], picture[which]);
    }
    if (changed.has("lights")) this.showLights(new Map(Object.entries(picture.lights)));
    if (changed.has("route")) this.route.setAttribute("points", points(picture.route));
    if (changed.has("obstacles")) this.showObstacles(picture.obstacles);
    if (changed.has("mission")) {
      const goals = picture.mission ? picture.mission.goals : [];
      const { step, phase, skipped } = picture.mission || {};
      const key = [goals, step, phase, skipped];
      this.memory.once("goals", key, () => this.showGoals(goals, picture.mission));
    }
  }

  /** Draw a sweep in the robot's frame, so that it moves with the robot between two sweeps. */
  showSweep(drawn, sweep) {
    if (!sweep) {
      drawn.area.removeAttribute("d");
      drawn.echoes.removeAttribute("d");
      return;
    }
    let [area, echoes] = ["M0 0", ""];
    sweep.cm.forEach((cm, i) => {
      const range = cm < 0 ? sweep.max_m : cm / 100;
      const angle = sweep.from_rad + i * sweep.step_rad;
      const at = `${(range * Math.cos(angle)).toFixed(2)} ${(-range * Math.sin(angle)).toFixed(2)}`;
      area += `L${at}`;
      if (cm >= 0) echoes += `M${at}h0`;
    });
    drawn.area.setAttribute("d", `${area}Z`);
    drawn.echoes.setAttribute("d", echoes || "M0 0");
    drawn.echoes.setAttribute("visibility", echoes ? "inherit" : "hidden");
  }

  showRobot(pose, pilot) {
    if (!pose) return;
    if (!finite(pose.value)) {
      this.robot.classList.add("stale");  // last known pose
      return;
    }
    const { x_m: x, y_m: y, yaw_rad: yaw } = pose.value;
    this.view.at = [x, y];
    if (this.view.following) this.view.look();
    this.svg.dataset.t = pose.t;  // time of the shown pose
    this.robot.setAttribute("visibility", "visible");
    this.robot.setAttribute("transform", `translate(${x} ${-y}) rotate(${-yaw * 180 / Math.PI})`);
    this.robot.classList.toggle("stale", pose.stale);
    this.robot.classList.toggle("stopped", Boolean(pilot && pilot.value.stopped));
    const last = this.track[this.track.length - 1];
    if (!last || Math.hypot(last[0] - x, last[1] - y) > TRACK_STEP_M) {
      this.track.push([x, y]);
      if (this.track.length > TRACK_POINTS) this.track = this.track.filter((_, i) => i % 2 === 0);
      this.trackLine.setAttribute("points", points(this.track));
    }
  }

  showLights(measured) {
    for (const [name, shown] of this.lights) {
      const light = measured.get(name);
      const verdict = light ? light.verdict : "none";
      if (verdict === shown.verdict) continue;
      shown.verdict = verdict;
      shown.dot.setAttribute("class", `light ${verdict}`);
      shown.cross.setAttribute("visibility", verdict === "out" ? "visible" : "hidden");
      shown.title.textContent = light
        ? `${name}: ${verdict}, ${light.intensity_cd} cd (${Math.round(light.ratio * 100)} %)`
        : `${name}: not measured`;
    }
  }

  showObstacles(obstacles) {
    this.obstacles.replaceChildren();
    for (const o of obstacles) {
      const circle = make("circle", { class: "obstacle", cx: o.x_m, cy: -o.y_m, r: o.radius_m }, this.obstacles);
      make("title", {}, circle, o.name);
    }
  }

  showGoals(goals, mission) {
    this.goals.replaceChildren();
    goals.forEach((goal, i) => {
      const skipped = mission.skipped.includes(i);
      const done = !skipped && (i < mission.step || mission.phase === "succeeded");
      const now = i === mission.step && ["running", "paused"].includes(mission.phase);
      const group = this.mark(goal.x_m, goal.y_m, this.goals);
      if (now) make("circle", { class: "goal now", r: .45 }, group);
      make("circle", { class: `goal ${done ? "done" : ""}`, r: 1.1 }, group);
      make("text", { y: -1.5, "font-size": 1.7, "text-anchor": "middle" }, group,
        skipped ? `${i + 1} skipped` : done ? `${i + 1} ✓` : i + 1);
    });
  }
}

const SIGNS = [["mark ok", "ok"], ["mark dim", "dim"], ["mark out", "out", "✕"], ["mark none", "not measured"],
  ["line track", "track"], ["line route", "route"], ["mark laser", "laser"], ["mark obstacle", "obstacle"],
  ["patch prohibited", "prohibited"]];

/** The panel: the map, a button to follow the robot, where it is, and what the signs mean. */
export default class MapPanel {
  constructor(room) {
    room.section.dataset.columns = 2;
    this.name = Object.assign(element("span", "quiet"), { id: "airport" });
    this.button = Object.assign(element("button", "small", "Follow robot"), { id: "follow", type: "button" });
    this.button.setAttribute("aria-pressed", "false");
    const canvas = make("svg", { id: "map", role: "img",
      "aria-label": "Map of the airport with the robot, its track, the laser and the lights; arrows move it, plus and minus zoom, 0 shows all" });
    this.where = element("p", "quiet where");
    this.where.id = "where";
    const legend = element("ul", "legend");
    legend.setAttribute("aria-label", "Signs on the map");
    for (const [sign, text, letter] of SIGNS) {
      const line = element("li");
      line.append(element("i", sign, letter), text);
      legend.append(line);
    }
    room.body.append(canvas, this.where, legend);
    this.map = new AirportMap(canvas);
    const { view } = this.map;
    this.map.onLook = () => this.button.setAttribute("aria-pressed", String(view.following));
    this.button.addEventListener("click", () => view.follow(!view.following, FOLLOW_M));
    room.title.append(" ", this.name, element("span", "grow"), ...view.buttons(), this.button);
  }

  begin(hello) {
    this.map.begin(hello.map || null, hello.track || [], hello.footprint_m);
    say(this.name, hello.map ? hello.map.name : "");
    this.place(null);
  }

  show(picture, changed) {
    this.map.show(picture, changed);
    if (changed.has("pose")) this.place(picture.pose);
  }

  place(pose) {
    const { x_m: x, y_m: y, yaw_rad: yaw } = pose ? pose.value : {};
    const heading = (90 - yaw * 180 / Math.PI + 360) % 360;
    say(this.where, [x, y, yaw].every(Number.isFinite)
      ? `Robot at ${x.toFixed(1)} m east, ${y.toFixed(1)} m north, heading ${heading.toFixed(0).padStart(3, "0")}°${pose.stale ? " (not heard any more)" : ""}`
      : "The robot's pose is unknown.");
  }
}

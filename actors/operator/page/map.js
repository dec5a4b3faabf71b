// The airport's map as SVG: metres, y turned over so that north is up.

const NS = "http://www.w3.org/2000/svg";

function make(tag, attributes, parent, text) {
  const element = document.createElementNS(NS, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  if (text !== undefined) element.textContent = text;
  if (parent) parent.append(element);
  return element;
}

function points(list) {
  return list.map(([x, y]) => `${x},${-y}`).join(" ");
}

const finite = (pose) => [pose.x_m, pose.y_m, pose.yaw_rad].every(Number.isFinite);

export class AirportMap {
  constructor(svg) {
    this.svg = svg;
    this.lights = new Map();
    this.track = [];
    this.drawn = {};
  }

  /** Draw what does not move; `map` is an AirportDrawing or null, `track` the way driven so far. */
  begin(map, track) {
    this.svg.replaceChildren();
    this.lights.clear();
    this.drawn = {};
    const [x0, y0, x1, y1] = map ? map.bounds_m : [-50, -50, 50, 50];
    this.svg.setAttribute("viewBox", `${x0} ${-y1} ${x1 - x0} ${y1 - y0}`);
    const hatch = make("pattern", { id: "hatch", width: 1, height: 1,
      patternUnits: "userSpaceOnUse", patternTransform: "rotate(45)" }, make("defs", {}, this.svg));
    make("rect", { class: "hatch-ground", width: 1, height: 1 }, hatch);
    make("line", { class: "hatch-line", y2: 1 }, hatch);
    const ground = make("g", { transform: "scale(1,-1)" }, this.svg);
    if (map) this.drawGround(map, ground);
    this.edges = make("g", {}, this.svg);
    for (const [ax, ay, bx, by] of map ? map.edges : []) {
      make("line", { class: "edge", x1: ax, y1: -ay, x2: bx, y2: -by }, this.edges);
    }
    for (const [name, [x, y]] of Object.entries(map ? map.nodes : {})) {
      make("title", {}, make("circle", { class: "node", cx: x, cy: -y, r: .28 }, this.edges), name);
    }
    this.route = make("polyline", { class: "route" }, this.svg);
    this.trackLine = make("polyline", { class: "track" }, this.svg);
    this.goals = make("g", {}, this.svg);
    this.lightLayer = make("g", {}, this.svg);
    for (const light of map ? map.lights : []) this.addLight(light);
    this.obstacles = make("g", {}, this.svg);
    this.robot = make("g", { class: "robot", visibility: "hidden" }, this.svg);
    make("circle", { class: "robot-ring", r: 1.7 }, this.robot);
    make("path", { class: "robot-body", d: "M1.1 0L-.75 .75L-.4 0L-.75 -.75Z" }, this.robot);
    this.track = track.filter((p) => p.every(Number.isFinite));
    this.trackLine.setAttribute("points", points(this.track));
  }

  drawGround(map, ground) {
    // Pavement first: the prohibited area (all that is not allowed) then covers what it forbids.
    for (const [kind, path] of map.surfaces) make("path", { class: `pavement ${kind}`, d: path }, ground);
    make("path", { class: "prohibited-area", d: map.prohibited, "fill-rule": "evenodd" }, ground);
    for (const [name, path] of map.buildings) {
      make("title", {}, make("path", { class: "building", d: path }, ground), name);
    }
  }

  addLight(light) {
    const group = make("g", { transform: `translate(${light.x_m} ${-light.y_m})` }, this.lightLayer);
    const dot = make("circle", { class: "light none", r: .55 }, group);
    const cross = make("path", { class: "cross", d: "M-.8 -.8L.8 .8M.8 -.8L-.8 .8", visibility: "hidden" }, group);
    const title = make("title", {}, group, `${light.name}: not measured`);
    this.lights.set(light.name, { dot, cross, title, verdict: "none" });
  }

  /** Show a state as the HMI pushed it. */
  show(state) {
    this.showRobot(state.pose, state.pilot);
    this.showLights(state.lights);
    this.once("route", state.route, () => this.route.setAttribute("points", points(state.route)));
    this.once("obstacles", state.obstacles, () => this.showObstacles(state.obstacles));
    const goals = state.mission ? state.mission.goals : [];
    this.once("goals", [goals, state.mission && state.mission.step], () => this.showGoals(goals, state.mission));
  }

  /** Redraw only what changed: most states bring a new pose and nothing else. */
  once(name, value, draw) {
    const text = JSON.stringify(value);
    if (this.drawn[name] === text) return;
    this.drawn[name] = text;
    draw();
  }

  showRobot(pose, pilot) {
    if (!pose || !finite(pose.value)) return;
    const { x_m: x, y_m: y, yaw_rad: yaw } = pose.value;
    this.robot.setAttribute("visibility", "visible");
    this.robot.setAttribute("transform", `translate(${x} ${-y}) rotate(${-yaw * 180 / Math.PI})`);
    this.robot.classList.toggle("stale", pose.stale);
    this.robot.classList.toggle("stopped", Boolean(pilot && pilot.value.stopped));
    const last = this.track[this.track.length - 1];
    if (!last || Math.hypot(last[0] - x, last[1] - y) > .25) {
      this.track.push([x, y]);
      if (this.track.length > 6000) this.track.splice(0, 1000);
      this.trackLine.setAttribute("points", points(this.track));
    }
  }

  showLights(measured) {
    for (const [name, shown] of this.lights) {
      const light = measured[name];
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
      const done = i < mission.step || mission.phase === "succeeded";
      make("circle", { class: `goal ${done ? "done" : ""}`, cx: goal.x_m, cy: -goal.y_m, r: 1.1 }, this.goals);
      make("text", { x: goal.x_m, y: -goal.y_m - 1.5, "font-size": 1.7, "text-anchor": "middle" }, this.goals, i + 1);
    });
  }
}

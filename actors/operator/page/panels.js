// Panels of the robot and of the specification, drawn by widgets or by scripts of the robot.
//
// A script's default export is a class `(room, page)`. `room` has the panel's `section`, `title` and
// `body`. `page` has `send(wish)`, `toast(text)`, the declaration `declared`, `barred(kind)`, which
// returns why the visitor may not make requests of a type ("" if permitted), and `bar(part, kind)`,
// which disables a part of the panel in that case and shows why; call it from `begin`. The class may
// have `begin(hello)` for each connection, `take(state)` for each message of the picture, also while
// the page is hidden, `show(picture, changed)` for each frame, `receive(message)` for other messages
// of the HMI (true if it was for this panel), and `offline()`.

import { element } from "./dom.js";
import { WIDGETS } from "./widgets.js";

export class Panels {
  constructor(arrangement, page) {
    this.arrangement = arrangement;
    this.page = page;
    this.declared = "";
    this.widgets = [];
    this.sections = [];
  }

  /** Begin a connection. Panels that are the same as before stay, even a stick that is held. */
  async begin(hello) {
    const declared = JSON.stringify([hello.system, hello.panels]);
    if (declared !== this.declared) {
      const drawers = await Promise.all(hello.panels.map(drawerOf));
      this.declared = declared;
      for (const section of this.sections) section.remove();
      this.sections = hello.panels.map((panel, i) => this.frame(panel, i));
      this.arrangement.main.prepend(...this.sections);
      this.widgets = hello.panels.map((panel, i) => this.widget(panel, drawers[i], this.sections[i]));
      this.arrangement.begin(hello.system);
    }
    this.each("begin", hello);
  }

  frame(panel, i) {
    const section = Object.assign(element("details", "panel"), { open: true });
    const title = Object.assign(element("h2", "", panel.title), { id: `own-${i}` });
    const summary = element("summary");
    section.setAttribute("aria-labelledby", title.id);
    section.dataset.name = panel.title;
    summary.append(title);
    section.append(summary, element("div", "inside"));
    this.arrangement.adopt(section);
    return section;
  }

  widget(panel, drawer, section) {
    const [head, body] = section.children;
    const room = { section, title: head.firstElementChild, body };
    try {
      const made = new drawer(room, { ...this.page, declared: panel });
      if (panel.columns) section.dataset.columns = panel.columns;
      return made;
    } catch (error) {
      reportError(error);
      return new (broken(error))(room);
    }
  }

  /** Call a method of all widgets that have it; an error in one does not affect the others. */
  each(method, ...values) {
    return this.widgets.map((widget) => {
      try {
        return widget[method]?.(...values);
      } catch (error) {
        reportError(error);
        return undefined;
      }
    });
  }

  take(state) { this.each("take", state); }

  show(picture, changed) { this.each("show", picture, changed); }

  receive(message) { return this.each("receive", message).includes(true); }

  offline() { this.each("offline"); }
}

async function drawerOf(panel) {
  try {
    if (panel.script) return (await import(`./robot/${panel.script}`)).default;
    return WIDGETS[Object.keys(WIDGETS).find((kind) => kind in panel)];
  } catch (error) {
    return broken(error);
  }
}

const broken = (error) => class {
  constructor(room) { room.body.replaceChildren(element("p", "quiet", `Cannot be shown: ${error.message}`)); }
};

// A picture of the robot, rendered while a page shows it. The page requests the next picture when it
// has drawn the last one, so a slow page or renderer gets fewer pictures and no backlog.

import { $, say } from "./dom.js";

const PAUSE_MS = 200;
const RETRY_MS = 5000;

export class Camera {
  constructor() {
    this.on = false;
    this.timer = 0;
    $("camera-show").addEventListener("click", () => this.turn(!this.on));
    document.addEventListener("visibilitychange", () => this.next(0));
  }

  begin(offered) {
    $("camera-panel").hidden = !offered;
    if (!offered) this.turn(false);
  }

  turn(on) {
    this.on = on;
    $("camera-show").setAttribute("aria-pressed", on);
    $("camera-show").textContent = on ? "Hide" : "Show";
    $("camera").hidden = true;
    say($("camera-text"), on ? "Starting the renderer …" : "");
    this.next(0);
  }

  next(delayMs) {
    clearTimeout(this.timer);
    if (this.on && !document.hidden) this.timer = setTimeout(() => this.take(), delayMs);
  }

  async take() {
    let delayMs = RETRY_MS;
    try {
      const answer = await fetch("camera.jpg", { cache: "no-store" });
      if (answer.ok) {
        await this.draw(await createImageBitmap(await answer.blob()));
        delayMs = PAUSE_MS;
      } else {
        this.fail(await answer.text());
      }
    } catch {
      this.fail("the HMI is not reachable");
    }
    this.next(delayMs);
  }

  draw(bitmap) {
    if (!this.on) return;
    const canvas = $("camera");
    [canvas.width, canvas.height] = [bitmap.width, bitmap.height];
    canvas.getContext("2d").drawImage(bitmap, 0, 0);
    canvas.hidden = false;
    say($("camera-text"), "");
  }

  fail(reason) {
    if (!this.on) return;
    $("camera").hidden = true;
    say($("camera-text"), `No picture: ${reason}.`);
  }
}

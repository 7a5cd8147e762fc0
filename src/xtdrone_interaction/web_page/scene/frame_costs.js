// What frames cost: the time of this page's own code and of the calls to the graphics, draw calls and triangles.
const KEPT = 120; // frames

export class FrameCosts {
  #updates = new Float32Array(KEPT);
  #renders = new Float32Array(KEPT);
  #count = 0;
  calls = 0;
  triangles = 0;
  first = 0; // ms from the navigation to the end of the first frame with the vehicles; 0 before it

  /** Notes a frame: ms of the page's code, ms of the graphics' calls, what was drawn, and whether vehicles were. */
  note(update, render, calls, triangles, vehicles) {
    const at = this.#count % KEPT;
    this.#updates[at] = update;
    this.#renders[at] = render;
    if (vehicles && !this.first) this.first = performance.now();
    this.#count += 1;
    this.calls = calls;
    this.triangles = triangles;
  }

  restart() { this.#count = 0; }

  /** Returns medians over the last frames: update and render, ms; and the newest draw calls and triangles. */
  summary() {
    const count = Math.min(this.#count, KEPT);
    const median = (values) => values.slice(0, count).sort()[Math.floor(count / 2)];
    return { frames: count, update: median(this.#updates), render: median(this.#renders), calls: this.calls, triangles: this.triangles };
  }
}

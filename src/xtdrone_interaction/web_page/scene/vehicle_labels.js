// Names over the vehicles, each drawn once and then copied to where its vehicle is seen.
import { COLUMNS } from '../fleet_frame.js';

const ABOVE = 28; // px from a vehicle to the top of its name

export class VehicleLabels {
  canvas = document.createElement('canvas');
  #context = this.canvas.getContext('2d');
  #pictures = new Map(); // name -> canvas
  #theme = '';
  #drawn = false;

  constructor() { this.canvas.style.cssText = 'position:absolute;inset:0;pointer-events:none'; }

  resize(width, height) {
    this.canvas.width = width;
    this.canvas.height = height;
  }

  /**
   * Draws the names of vehicles where a camera sees them.
   * @param vehicles of the roster
   * @param {Float32Array} rows of the fleet
   * @param {ArrayLike<number>} seen elements of the matrix from the world to the camera's cube
   * @param {(name: string) => boolean} wanted whether a name is shown
   */
  draw(vehicles, rows, seen, wanted) {
    const { width, height } = this.canvas;
    if (this.#drawn) this.#context.clearRect(0, 0, width, height);
    this.#drawn = false;
    const { theme } = document.documentElement.dataset;
    if (theme !== this.#theme) { this.#theme = theme; this.#pictures.clear(); }
    for (let i = 0; i < vehicles.length; i++) {
      const { name } = vehicles[i];
      if (!wanted(name)) continue;
      const x = rows[i * COLUMNS], y = rows[i * COLUMNS + 1], z = rows[i * COLUMNS + 2];
      const depth = seen[3] * x + seen[7] * y + seen[11] * z + seen[15];
      if (!(depth > 0)) continue; // behind the camera, or absent
      const right = (0.5 + (0.5 * (seen[0] * x + seen[4] * y + seen[8] * z + seen[12])) / depth) * width;
      const down = (0.5 - (0.5 * (seen[1] * x + seen[5] * y + seen[9] * z + seen[13])) / depth) * height;
      if (right < -60 || right > width + 60 || down < 0 || down > height + 40) continue;
      const picture = this.#pictures.get(name) ?? this.#picture(name);
      this.#context.drawImage(picture, Math.round(right - picture.width / 2), Math.round(down - ABOVE));
      this.#drawn = true;
    }
  }

  #picture(name) {
    const picture = document.createElement('canvas');
    const pen = picture.getContext('2d');
    const font = '12px system-ui, sans-serif';
    pen.font = font;
    picture.width = Math.ceil(pen.measureText(name).width) + 6;
    picture.height = 18;
    const dark = this.#theme === 'dark';
    Object.assign(pen, { font, textAlign: 'center', lineWidth: 3, strokeStyle: dark ? '#11161dcc' : '#ffffffcc', fillStyle: dark ? '#e9eef5' : '#1a2330' });
    pen.strokeText(name, picture.width / 2, 13);
    pen.fillText(name, picture.width / 2, 13);
    this.#pictures.set(name, picture);
    return picture;
  }
}

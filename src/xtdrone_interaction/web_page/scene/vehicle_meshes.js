// The vehicles: for each model one instanced mesh of bodies and one of rotors, whatever the number of vehicles.
import {
  BoxGeometry, BufferAttribute, BufferGeometry, Color, DoubleSide, DynamicDrawUsage, Group, InstancedMesh, Matrix4, MeshBasicMaterial,
  MeshLambertMaterial, Points, PointsMaterial, Quaternion, TorusGeometry, Vector3,
} from '../vendor/three.js';
import { COLUMNS } from '../fleet.js';

const SPIN = 28; // rad/s that an armed rotor is seen to turn; the true one would seem to stand or to turn back
const FAR = 35; // m from which vehicles are marked by a spot
const WHITE = new Color(1, 1, 1);
const PICKED = new Color(1.6, 1.35, 0.7);

/** Returns the colour of the vehicle of a number: hues that differ most for neighbours. */
export function colourOf(number) { return new Color().setHSL((number * 0.61803) % 1, 0.75, 0.52); }

export class VehicleMeshes {
  group = new Group();
  #shapes;
  #station;
  #kinds = []; // of each model: {bodies, blades, rotors, numbers}
  #version = -1;
  #spots = null;
  #rings = null;
  #angle = 0;

  constructor(station, shapes) {
    this.#station = station;
    this.#shapes = shapes;
  }

  /** Makes the meshes of a roster's vehicles. */
  async build(roster) {
    this.#version = roster.version;
    const models = [...new Set(roster.vehicles.map(({ model }) => model))];
    const kinds = await Promise.all(models.map((model) => this.#kind(model, roster.vehicles)));
    if (this.#version !== roster.version) return; // a newer one came meanwhile
    this.group.clear();
    this.#kinds = kinds;
    for (const { bodies, blades } of kinds) this.group.add(bodies, blades);
    this.#addMarks(roster.vehicles.length);
  }

  async #kind(model, vehicles) {
    const numbers = vehicles.flatMap((vehicle, i) => (vehicle.model === model ? [i] : []));
    const { body, rotors } = await this.#station.call('world.vehicle', { model });
    const geometry = await this.#shapes.merged(body);
    const bodies = new InstancedMesh(geometry, new MeshLambertMaterial({ vertexColors: true }), numbers.length);
    const radius = rotors[0]?.radius ?? 0.1;
    const blade = new BoxGeometry(2 * radius, 0.16 * radius, 0.006);
    const blades = new InstancedMesh(blade, new MeshLambertMaterial({ color: 0x30343a }), Math.max(1, numbers.length * rotors.length));
    for (const mesh of [bodies, blades]) {
      mesh.instanceMatrix.setUsage(DynamicDrawUsage);
      mesh.frustumCulled = false;
    }
    numbers.forEach((_, i) => bodies.setColorAt(i, WHITE));
    return { bodies, blades, rotors, numbers };
  }

  #addMarks(count) {
    const geometry = new BufferGeometry();
    geometry.setAttribute('position', new BufferAttribute(new Float32Array(3 * count), 3).setUsage(DynamicDrawUsage));
    const colours = new Float32Array(3 * count);
    for (let i = 0; i < count; i++) colourOf(i).toArray(colours, 3 * i);
    geometry.setAttribute('color', new BufferAttribute(colours, 3));
    this.#spots = new Points(geometry, new PointsMaterial({ size: 8, sizeAttenuation: false, vertexColors: true }));
    this.#spots.frustumCulled = false;
    const ring = new TorusGeometry(0.55, 0.03, 6, 24);
    this.#rings = new InstancedMesh(ring, new MeshBasicMaterial({ color: 0xffa800, side: DoubleSide }), Math.max(1, count));
    this.#rings.frustumCulled = false;
    this.group.add(this.#spots, this.#rings);
  }

  /**
   * Places all vehicles.
   * @param {Float32Array} rows of the fleet, NaN for absent vehicles
   * @param {number} seconds since the last call, for the rotors
   * @param {number} distance of the camera, m
   */
  update(rows, seconds, distance) {
    if (!this.#spots || rows.length !== COLUMNS * this.#spots.geometry.attributes.position.count) return;
    this.#angle = (this.#angle + SPIN * seconds) % (2 * Math.PI);
    for (const kind of this.#kinds) this.#place(kind, rows);
    const spots = this.#spots.geometry.attributes.position;
    for (let i = 0; i < spots.count; i++) {
      for (let k = 0; k < 3; k++) spots.array[3 * i + k] = rows[i * COLUMNS + k];
    }
    spots.needsUpdate = true;
    this.#spots.visible = distance > FAR;
    this.#ring(rows);
  }

  #place({ bodies, blades, rotors, numbers }, rows) {
    numbers.forEach((number, i) => {
      const at = number * COLUMNS;
      if (Number.isNaN(rows[at])) { matrix.makeScale(0, 0, 0); } else {
        position.set(rows[at], rows[at + 1], rows[at + 2]);
        rotation.set(rows[at + 4], rows[at + 5], rows[at + 6], rows[at + 3]);
        matrix.compose(position, rotation, one);
      }
      bodies.setMatrixAt(i, matrix);
      const { name } = this.#station.roster.vehicles[number] ?? {};
      bodies.setColorAt(i, this.#station.selection.has(name) ? PICKED : WHITE);
      const armed = this.#station.status.vehicles[name]?.armed;
      rotors.forEach((rotor, k) => {
        const angle = armed ? rotor.direction * (this.#angle + k) : k;
        blade.makeRotationZ(angle).setPosition(...rotor.position);
        blades.setMatrixAt(i * rotors.length + k, blade.premultiply(matrix));
      });
    });
    bodies.instanceMatrix.needsUpdate = true;
    bodies.instanceColor.needsUpdate = true;
    blades.instanceMatrix.needsUpdate = true;
  }

  #ring(rows) {
    let count = 0;
    this.#station.roster.vehicles.forEach(({ name }, i) => {
      if (!this.#station.selection.has(name) || Number.isNaN(rows[i * COLUMNS])) return;
      matrix.makeTranslation(rows[i * COLUMNS], rows[i * COLUMNS + 1], rows[i * COLUMNS + 2]);
      this.#rings.setMatrixAt(count++, matrix);
    });
    this.#rings.count = count;
    this.#rings.instanceMatrix.needsUpdate = true;
  }
}

const matrix = new Matrix4();
const blade = new Matrix4();
const position = new Vector3();
const rotation = new Quaternion();
const one = new Vector3(1, 1, 1);

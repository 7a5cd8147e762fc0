// The vehicles: for each model one instanced mesh of bodies that are near, one of those that are far and one of rotors.
import {
  BoxGeometry, BufferAttribute, BufferGeometry, Color, DoubleSide, DynamicDrawUsage, Group, InstancedMesh, MeshBasicMaterial,
  MeshLambertMaterial, Points, PointsMaterial, SRGBColorSpace, TorusGeometry,
} from '../vendor/three.js';
import { COLUMNS } from '../fleet_frame.js';
import { writePose, writeTurned } from './instance_matrices.js';
import { matrixOf, release } from './shapes.js';
import { simplerMesh } from './simpler_mesh.js';

const SPIN = 28; // rad/s that an armed rotor is seen to turn; the true one would seem to stand or to turn back
const FAR = 35; // m of the camera from which vehicles are marked by a spot
const NEAR = 12; // m from a vehicle up to which its whole mesh is drawn
const MOST_NEAR = 12; // vehicles whose whole mesh is drawn, so that a dense swarm costs no more
const ROTORS_SEEN = 60; // m
const CELLS = 14; // of the far mesh
const WHITE = [1, 1, 1];
const PICKED = [1.6, 1.35, 0.7];

/** Returns the colour of the vehicle of a number: hues that differ most for neighbours. */
export function colourOf(number) { return new Color().setHSL((number * 0.61803) % 1, 0.75, 0.46, SRGBColorSpace); }

export class VehicleMeshes {
  group = new Group();
  #shapes;
  #station;
  #kinds = []; // of each model: meshes near, far and blades, places and directions of rotors, numbers of the vehicles
  #version = -1;
  #spots = null;
  #rings = null;
  #angle = 0;
  #armed = new Uint8Array(0);
  #picked = new Uint8Array(0);
  anyArmed = false;
  shown = false; // whether the meshes are there

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
    release(this.group);
    this.#kinds = kinds;
    for (const { near, far, blades } of kinds) this.group.add(near, far, blades);
    this.#armed = new Uint8Array(roster.vehicles.length);
    this.#picked = new Uint8Array(roster.vehicles.length);
    this.#addMarks(roster.vehicles.length);
    this.shown = roster.vehicles.length > 0;
    this.note();
  }

  async #kind(model, vehicles) {
    const numbers = vehicles.flatMap((vehicle, i) => (vehicle.model === model ? [i] : []));
    const { body, rotors } = await this.#station.call('world.vehicle', { model });
    const geometry = await this.#shapes.merged(body.map((shape) => ({ shape, matrix: matrixOf(shape.pose, shape.size) })));
    const material = new MeshLambertMaterial({ vertexColors: true });
    const radius = rotors[0]?.radius ?? 0.1;
    const blade = new BoxGeometry(2 * radius, 0.16 * radius, 0.006);
    return {
      near: instanced(geometry, material, Math.min(numbers.length, MOST_NEAR), true),
      far: instanced(simplerMesh(geometry, CELLS), material, numbers.length, true),
      blades: instanced(blade, new MeshLambertMaterial({ color: 0x30343a }), numbers.length * rotors.length, false),
      places: rotors.map(({ position }) => position),
      directions: rotors.map(({ direction }) => direction),
      numbers,
    };
  }

  #addMarks(count) {
    const geometry = new BufferGeometry();
    geometry.setAttribute('position', new BufferAttribute(new Float32Array(3 * count), 3).setUsage(DynamicDrawUsage));
    const colours = new Float32Array(3 * count);
    for (let i = 0; i < count; i++) colourOf(i).toArray(colours, 3 * i);
    geometry.setAttribute('color', new BufferAttribute(colours, 3));
    this.#spots = new Points(geometry, new PointsMaterial({ size: 8, sizeAttenuation: false, vertexColors: true }));
    this.#spots.frustumCulled = false;
    this.#rings = instanced(new TorusGeometry(0.55, 0.03, 6, 24), new MeshBasicMaterial({ color: 0xffa800, side: DoubleSide }), count, false);
    this.group.add(this.#spots, this.#rings);
  }

  /** Notes who is armed and who is selected; called when that changes, and not in each frame. */
  note() {
    const { roster, status, selection } = this.#station;
    this.anyArmed = false;
    for (let i = 0; i < this.#armed.length; i++) {
      const name = roster.vehicles[i]?.name;
      this.#armed[i] = status.vehicles[name]?.armed ? 1 : 0;
      this.#picked[i] = selection.has(name) ? 1 : 0;
      if (this.#armed[i]) this.anyArmed = true;
    }
  }

  /**
   * Places all vehicles.
   * @param {Float32Array} rows of the fleet, NaN for absent vehicles
   * @param {number} seconds since the last call, for the rotors
   * @param camera its position
   * @param {number} distance of the camera from what it looks at, m
   */
  update(rows, seconds, camera, distance) {
    if (!this.#spots || rows.length !== COLUMNS * this.#armed.length) return;
    this.#angle = (this.#angle + SPIN * seconds) % (2 * Math.PI);
    for (let i = 0; i < this.#kinds.length; i++) this.#place(this.#kinds[i], rows, camera);
    const spots = this.#spots.geometry.attributes.position;
    for (let i = 0; i < spots.count; i++) {
      for (let k = 0; k < 3; k++) spots.array[3 * i + k] = rows[i * COLUMNS + k];
    }
    spots.needsUpdate = true;
    this.#spots.visible = distance > FAR;
    this.#ring(rows);
  }

  #place({ near, far, blades, places, directions, numbers }, rows, camera) {
    near.count = far.count = blades.count = 0;
    const blade = blades.instanceMatrix.array;
    for (let i = 0; i < numbers.length; i++) {
      const number = numbers[i];
      const at = number * COLUMNS;
      if (Number.isNaN(rows[at])) continue;
      const gap = Math.hypot(rows[at] - camera.x, rows[at + 1] - camera.y, rows[at + 2] - camera.z);
      const mesh = gap < NEAR && near.count < near.instanceMatrix.count ? near : far;
      const body = mesh.count;
      mesh.count += 1;
      writePose(mesh.instanceMatrix.array, body, rows, number);
      const colour = this.#picked[number] ? PICKED : WHITE;
      for (let k = 0; k < 3; k++) mesh.instanceColor.array[3 * body + k] = colour[k];
      if (gap > ROTORS_SEEN) continue;
      for (let k = 0; k < places.length; k++) {
        const angle = this.#armed[number] ? directions[k] * (this.#angle + k) : k;
        writeTurned(blade, blades.count, mesh.instanceMatrix.array, body, places[k], angle);
        blades.count += 1;
      }
    }
    upload(near);
    upload(far);
    upload(blades);
  }

  #ring(rows) {
    const { array } = this.#rings.instanceMatrix;
    let count = 0;
    for (let i = 0; i < this.#picked.length; i++) {
      if (!this.#picked[i] || Number.isNaN(rows[i * COLUMNS])) continue;
      for (let k = 0; k < 16; k++) array[16 * count + k] = k % 5 === 0 ? 1 : 0;
      for (let k = 0; k < 3; k++) array[16 * count + 12 + k] = rows[i * COLUMNS + k];
      count += 1;
    }
    this.#rings.count = count;
    this.#rings.instanceMatrix.needsUpdate = true;
  }
}

/** Returns an instanced mesh without instances, with room for a number of them. */
function instanced(geometry, material, most, coloured) {
  const mesh = new InstancedMesh(geometry, material, Math.max(1, most));
  mesh.instanceMatrix.setUsage(DynamicDrawUsage);
  if (coloured) mesh.setColorAt(0, new Color(1, 1, 1)); // makes room for all
  mesh.frustumCulled = false;
  mesh.count = 0;
  return mesh;
}

function upload(mesh) {
  mesh.visible = mesh.count > 0;
  mesh.instanceMatrix.needsUpdate = true;
  if (mesh.instanceColor) mesh.instanceColor.needsUpdate = true;
}

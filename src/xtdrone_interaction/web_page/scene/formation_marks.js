// Slots of the formation and its topology.
import {
  BufferAttribute, BufferGeometry, DynamicDrawUsage, Group, InstancedMesh, LineBasicMaterial, LineSegments, Matrix4, MeshBasicMaterial,
  SphereGeometry,
} from '../vendor/three.js';
import { COLUMNS } from '../fleet_frame.js';

const matrix = new Matrix4(); // of no motion

export class FormationMarks {
  group = new Group();
  #formation = { offsets: [], links: [] };
  #slots = null;
  #lines = null;

  /** Takes offsets of the followers from the leader (vehicle 0), m, and links [from, to] between vehicles. */
  set(formation) {
    this.#formation = formation;
    this.group.clear();
    const material = new MeshBasicMaterial({ color: 0x2f9e44, wireframe: true, transparent: true, opacity: 0.55 });
    this.#slots = new InstancedMesh(new SphereGeometry(0.4, 8, 6), material, Math.max(1, formation.offsets.length));
    this.#slots.count = formation.offsets.length;
    for (let i = 0; i < formation.offsets.length; i++) this.#slots.setMatrixAt(i, matrix); // unturned; places follow
    this.#slots.instanceMatrix.setUsage(DynamicDrawUsage);
    this.#slots.visible = formation.offsets.length > 0;
    const geometry = new BufferGeometry();
    geometry.setAttribute('position', new BufferAttribute(new Float32Array(6 * formation.links.length), 3).setUsage(DynamicDrawUsage));
    this.#lines = new LineSegments(geometry, new LineBasicMaterial({ color: 0x8a63d2, transparent: true, opacity: 0.6 }));
    this.#lines.visible = formation.links.length > 0;
    this.#slots.frustumCulled = this.#lines.frustumCulled = false;
    this.group.add(this.#slots, this.#lines);
  }

  update(rows) {
    const { offsets, links } = this.#formation;
    if (!this.#slots || rows.length < COLUMNS) return;
    const { array } = this.#slots.instanceMatrix;
    for (let i = 0; i < offsets.length; i++) {
      for (let k = 0; k < 3; k++) array[16 * i + 12 + k] = rows[k] + offsets[i][k];
    }
    this.#slots.instanceMatrix.needsUpdate = true;
    const ends = this.#lines.geometry.attributes.position;
    for (let i = 0; i < links.length; i++) {
      for (let k = 0; k < 3; k++) {
        ends.array[6 * i + k] = rows[links[i][0] * COLUMNS + k] ?? 0;
        ends.array[6 * i + 3 + k] = rows[links[i][1] * COLUMNS + k] ?? 0;
      }
    }
    ends.needsUpdate = true;
  }
}

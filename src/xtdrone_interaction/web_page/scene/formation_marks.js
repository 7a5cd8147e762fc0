// Slots of the formation and its topology.
import {
  BufferAttribute, BufferGeometry, DynamicDrawUsage, Group, InstancedMesh, LineBasicMaterial, LineSegments, Matrix4, MeshBasicMaterial,
  SphereGeometry,
} from '../vendor/three.js';
import { COLUMNS } from '../fleet.js';

const matrix = new Matrix4();

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
    const geometry = new BufferGeometry();
    geometry.setAttribute('position', new BufferAttribute(new Float32Array(6 * formation.links.length), 3).setUsage(DynamicDrawUsage));
    this.#lines = new LineSegments(geometry, new LineBasicMaterial({ color: 0x8a63d2, transparent: true, opacity: 0.6 }));
    this.#slots.frustumCulled = this.#lines.frustumCulled = false;
    this.group.add(this.#slots, this.#lines);
  }

  update(rows) {
    const { offsets, links } = this.#formation;
    if (!this.#slots || rows.length < COLUMNS) return;
    offsets.forEach(([x, y, z], i) => {
      this.#slots.setMatrixAt(i, matrix.makeTranslation(rows[0] + x, rows[1] + y, rows[2] + z));
    });
    this.#slots.instanceMatrix.needsUpdate = true;
    const ends = this.#lines.geometry.attributes.position;
    links.forEach((link, i) => link.forEach((vehicle, end) => {
      for (let k = 0; k < 3; k++) ends.array[6 * i + 3 * end + k] = rows[vehicle * COLUMNS + k] ?? 0;
    }));
    ends.needsUpdate = true;
  }
}

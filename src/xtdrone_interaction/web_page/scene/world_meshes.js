// The surroundings: equal shapes of all models and people are one instanced mesh.
import { Color, Group, InstancedMesh, Matrix4, MeshLambertMaterial, Quaternion, SRGBColorSpace, Vector3 } from '../vendor/three.js';
import { COLUMNS } from '../fleet.js';
import { matrixOf } from './shapes.js';

export class WorldMeshes {
  group = new Group();
  #shapes;
  #parts = new Map(); // model's name -> [{mesh, index, local}]
  #asked = 0;

  constructor(shapes) { this.#shapes = shapes; }

  /** Shows a world as world.describe gives it, at the places of the roster. */
  async build(world, places) {
    const asked = ++this.#asked;
    const batches = new Map();
    for (const model of [...world.models, ...world.people]) {
      for (const shape of model.shapes) {
        const key = JSON.stringify([shape.kind, shape.mesh, shape.colour, shape.texture]);
        if (!batches.has(key)) batches.set(key, []);
        batches.get(key).push({ model, shape });
      }
    }
    const group = new Group();
    const parts = new Map();
    await Promise.all([...batches.values()].map(async (batch) => {
      const mesh = await this.#mesh(batch[0].shape, batch.length);
      batch.forEach(({ model, shape }, index) => {
        const local = matrixOf(shape.pose, shape.size);
        if (!parts.has(model.name)) parts.set(model.name, []);
        parts.get(model.name).push({ mesh, index, local });
        mesh.setMatrixAt(index, new Matrix4().multiplyMatrices(matrixOf(places[model.name] ?? model.pose), local));
      });
      group.add(mesh);
    }));
    if (asked !== this.#asked) return;
    this.#parts = parts;
    this.group.clear();
    this.group.add(group);
  }

  async #mesh(shape, count) {
    const [r, g, b, opacity] = shape.colour;
    const material = new MeshLambertMaterial({ color: new Color().setRGB(r, g, b, SRGBColorSpace), opacity, transparent: opacity < 1 });
    if (shape.texture !== null) material.map = await this.#shapes.texture(shape.texture).catch(() => null);
    const mesh = new InstancedMesh(await this.#shapes.geometry(shape), material, count);
    mesh.frustumCulled = false;
    return mesh;
  }

  /** Moves models to rows of a frame. */
  move(names, rows) {
    names.forEach((name, i) => {
      const at = i * COLUMNS;
      position.set(rows[at], rows[at + 1], rows[at + 2]);
      rotation.set(rows[at + 4], rows[at + 5], rows[at + 6], rows[at + 3]);
      root.compose(position, rotation, one);
      for (const { mesh, index, local } of this.#parts.get(name) ?? []) {
        mesh.setMatrixAt(index, whole.multiplyMatrices(root, local));
        mesh.instanceMatrix.needsUpdate = true;
      }
    });
  }
}

const root = new Matrix4();
const whole = new Matrix4();
const position = new Vector3();
const rotation = new Quaternion();
const one = new Vector3(1, 1, 1);

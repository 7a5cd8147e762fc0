// The surroundings: what stands is one mesh for each texture; of people and models that move, equal shapes are one instanced mesh.
import { Color, Group, InstancedMesh, Matrix4, Mesh, MeshLambertMaterial, Quaternion, SRGBColorSpace, Vector3 } from '../vendor/three.js';
import { COLUMNS } from '../fleet_frame.js';
import { matrixOf, release } from './shapes.js';

export class WorldMeshes {
  group = new Group();
  #shapes;
  #parts = new Map(); // model's name -> [{mesh, index, local}]
  #asked = 0;

  constructor(shapes) { this.#shapes = shapes; }

  /** Shows a world as world.describe gives it, at the places of the roster; people and movers can be moved. */
  async build(world, { places, movers }) {
    const asked = ++this.#asked;
    const moving = new Set([...movers, ...world.people.map(({ name }) => name)]);
    const [standing, batches] = [new Map(), new Map()];
    for (const model of [...world.models, ...world.people]) {
      const root = matrixOf(places[model.name] ?? model.pose);
      for (const shape of model.shapes) {
        const clear = shape.colour[3] < 1 && shape.colour;
        const entry = { model, shape, matrix: new Matrix4().multiplyMatrices(root, matrixOf(shape.pose, shape.size)) };
        if (moving.has(model.name)) add(batches, JSON.stringify([shape.kind, shape.mesh, shape.texture, clear]), entry);
        else add(standing, JSON.stringify([shape.texture, clear]), entry);
      }
    }
    const group = new Group();
    const parts = new Map();
    await Promise.all([
      ...[...standing.values()].map(async (entries) => {
        const material = await this.#material(entries[0].shape);
        material.vertexColors = true;
        group.add(new Mesh(await this.#shapes.merged(entries), material));
      }),
      ...[...batches.values()].map(async (entries) => {
        const mesh = await this.#mesh(entries[0].shape, entries.length);
        entries.forEach(({ model, shape, matrix }, index) => {
          mesh.setColorAt(index, new Color().setRGB(...shape.colour.slice(0, 3), SRGBColorSpace));
          mesh.setMatrixAt(index, matrix);
          add(parts, model.name, { mesh, index, local: matrixOf(shape.pose, shape.size) });
        });
        group.add(mesh);
      }),
    ]);
    if (asked !== this.#asked) return;
    this.#parts = parts;
    release(this.group);
    this.group.add(group);
  }

  /** Tells whether all models of these names can be moved. */
  moves(names) { return names.every((name) => this.#parts.has(name)); }

  async #material({ colour, texture }) {
    const material = new MeshLambertMaterial({ opacity: colour[3], transparent: colour[3] < 1 });
    if (texture !== null) material.map = await this.#shapes.texture(texture).catch(() => null);
    return material;
  }

  async #mesh(shape, count) {
    const mesh = new InstancedMesh(await this.#shapes.geometry(shape), await this.#material(shape), count);
    mesh.frustumCulled = false;
    return mesh;
  }

  /** Moves models to rows of a frame. */
  move(names, rows) {
    for (let i = 0; i < names.length; i++) {
      const parts = this.#parts.get(names[i]);
      if (!parts) continue;
      const at = i * COLUMNS;
      position.set(rows[at], rows[at + 1], rows[at + 2]);
      rotation.set(rows[at + 4], rows[at + 5], rows[at + 6], rows[at + 3]);
      root.compose(position, rotation, one);
      for (const { mesh, index, local } of parts) {
        mesh.setMatrixAt(index, whole.multiplyMatrices(root, local));
        mesh.instanceMatrix.needsUpdate = true;
      }
    }
  }
}

const root = new Matrix4();
const whole = new Matrix4();
const position = new Vector3();
const rotation = new Quaternion();
const one = new Vector3(1, 1, 1);

function add(lists, key, entry) {
  if (!lists.has(key)) lists.set(key, []);
  lists.get(key).push(entry);
}

// The 3D view: vehicles, world, trails, formation, layers; cameras, picking, and the goal of "go to" by a click.
import {
  Color, DirectionalLight, GridHelper, HemisphereLight, MapControls, Matrix4, Mesh, MeshBasicMaterial, PerspectiveCamera, Plane,
  PlaneGeometry, Raycaster, Scene, SRGBColorSpace, Vector2, Vector3, WebGLRenderer,
} from '../vendor/three.js';
import { COLUMNS } from '../fleet_frame.js';
import { LayerFeed } from '../layers/layer_feed.js';
import { LayerList } from '../layers/layer_list.js';
import { toast } from '../station.js';
import { FrameCosts } from '../scene/frame_costs.js';
import { FormationMarks } from '../scene/formation_marks.js';
import { LayerObjects } from '../scene/layer_objects.js';
import { Motion } from '../scene/motion.js';
import { Shapes } from '../scene/shapes.js';
import { Trails } from '../scene/trails.js';
import { VehicleLabels } from '../scene/vehicle_labels.js';
import { VehicleMeshes } from '../scene/vehicle_meshes.js';
import { WorldMeshes } from '../scene/world_meshes.js';

const FLEET = 1;
const PICK = 26; // px
const MOST_NAMES = 40;
const GROUND = 2000; // m
const SLOW = 20; // frames per second below which less is drawn
const FAST = 40;
const LEAST_DETAIL = 0.4;
const SOFTWARE_PERIOD = 30; // ms between two frames without a GPU: about 30 frames per second; the rest belongs to the flight
const STILL = 1000; // ms without a frame after which rotors stand: time is paused

class View {
  #station;
  #element;
  #renderer;
  #scene = new Scene();
  #camera = new PerspectiveCamera(50, 1, 0.1, 5000);
  #controls;
  #labels = new VehicleLabels();
  #layers = new LayerObjects();
  #feed;
  #list;
  #worldName = '';
  #moved = ''; // names of the models that can be moved
  #numbers = new Map(); // of the vehicles, by name
  #seen = new Matrix4(); // from the world to the camera's cube
  #software = drawsInSoftware();
  #motion = new Motion();
  #movers = new Motion();
  #trails = new Trails();
  #marks = new FormationMarks();
  #vehicles;
  #world;
  #offs = [];
  #framed = false;
  #follow = null;
  #drawn = performance.now();
  #now = null; // rows as they are drawn
  #dirty = true;
  #ended = false;
  #ground;
  #grid = null;
  #detail = 1; // pixels drawn for a pixel of the screen, along an edge
  #second = { begin: 0, count: 0, busy: false };
  frames = 0; // drawn so far
  costs = new FrameCosts();

  constructor(element, station) {
    this.#station = station;
    this.#element = element;
    element.style.overflow = 'hidden';
    this.#renderer = new WebGLRenderer({ antialias: !this.#software, powerPreference: 'high-performance' });
    element.append(this.#renderer.domElement, this.#labels.canvas);
    this.#camera.up.set(0, 0, 1);
    this.#camera.position.set(-12, -16, 12);
    this.#controls = new MapControls(this.#camera, this.#renderer.domElement);
    this.#controls.maxPolarAngle = Math.PI / 2 - 0.02;
    this.#controls.addEventListener('change', () => { this.#dirty = true; });
    const shapes = new Shapes(station);
    this.#vehicles = new VehicleMeshes(station, shapes);
    this.#world = new WorldMeshes(shapes);
    this.#ground = new Mesh(new PlaneGeometry(GROUND, GROUND), new MeshBasicMaterial({ depthWrite: false }));
    this.#ground.renderOrder = -2; // below all else, also below what lies on it
    const sun = new DirectionalLight(0xffffff, 2.2);
    sun.position.set(-40, -30, 80);
    this.#scene.add(new HemisphereLight(0xffffff, 0x99a08c, 1.9), sun, this.#ground);
    this.#scene.add(this.#vehicles.group, this.#world.group, this.#marks.group, this.#layers.group);
    this.#buttons();
    this.#openLayers();
    this.#listen();
    this.#paint();
    requestAnimationFrame((time) => this.#draw(time));
  }

  end() {
    this.#ended = true;
    this.#offs.forEach((off) => off());
    this.#feed.end();
    this.#list.end();
    this.#controls.dispose();
    this.#renderer.dispose();
    this.#renderer.forceContextLoss();
    this.#element.replaceChildren();
  }

  #listen() {
    const station = this.#station;
    const resized = new ResizeObserver(() => this.#resize());
    resized.observe(this.#element);
    this.#offs.push(
      () => resized.disconnect(),
      station.onBinary(FLEET, () => this.#received(station.fleet)),
      station.on('fleet.roster', (roster) => this.#setRoster(roster)),
      station.on('fleet.formation', (formation) => this.#setFormation(formation)),
      station.on('world.changed', () => this.#loadWorld()),
      station.on('station.theme', () => this.#paint()),
      station.on('fleet.status', () => { this.#vehicles.note(); this.#dirty = true; }),
      station.selection.onChange(() => { this.#vehicles.note(); this.#dirty = true; }),
      station.onConnect(() => {
        this.#setRoster(station.roster);
        this.#loadWorld();
        station.call('fleet.formation').then((formation) => this.#setFormation(formation), report);
      }),
    );
    const canvas = this.#renderer.domElement;
    let down = null;
    canvas.addEventListener('pointerdown', (event) => { down = [event.clientX, event.clientY]; });
    canvas.addEventListener('pointerup', (event) => {
      if (down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < 4) this.#clicked(event);
    });
  }

  #openLayers() {
    this.#feed = new LayerFeed(this.#station, (topic, frame) => {
      this.#layers.set(topic, frame);
      this.#dirty = true;
    }, (topic, text) => this.#list.fault(topic, text));
    this.#list = new LayerList(this.#element, this.#station, this.#feed, (topic, on) => {
      if (!on) this.#layers.remove(topic);
      this.#dirty = true;
    });
  }

  /** Returns what is shown of a layer, for tests. */
  layer(topic) { return this.#layers.describe(topic); }

  #buttons() {
    const box = document.createElement('div');
    box.className = 'overlay row';
    box.style.cssText = 'top:10px;left:10px;margin:0';
    const add = (text, title, f) => {
      const button = document.createElement('button');
      button.textContent = text;
      button.title = title;
      button.onclick = () => f(button);
      box.append(button);
      return button;
    };
    add('All', 'see all vehicles', () => this.#frameAll());
    add('Top', 'look from above', () => this.#lookFrom(new Vector3(0, -0.001, 1)));
    this.followButton = add('Follow', 'follow the selected vehicle', () => this.#toggleFollow());
    add('Trails', 'show or hide the trails', (button) => {
      if (this.#trails.lines) this.#trails.lines.visible = button.classList.toggle('on');
      this.#dirty = true;
    }).classList.add('on');
    add('Slots', 'show or hide slots and topology', (button) => {
      this.#marks.group.visible = button.classList.toggle('on');
      this.#dirty = true;
    }).classList.add('on');
    add('World', 'show or hide models and people', (button) => {
      this.#world.group.visible = button.classList.toggle('on');
      this.#dirty = true;
    }).classList.add('on');
    this.#element.append(box);
  }

  async #setRoster(roster) {
    const count = roster.vehicles.length;
    const moved = roster.movers.join();
    const unseen = moved !== this.#moved && !this.#world.moves(roster.movers);
    if (unseen || !this.#worldName) this.#loadWorld(); // without a name: the page was there before the flight
    this.#moved = moved;
    this.#numbers = new Map(roster.vehicles.map(({ name }, i) => [name, i]));
    await this.#vehicles.build(roster).catch(report);
    if (this.#trails.count !== count) {
      this.#trails.count = count;
      if (this.#trails.lines) this.#scene.remove(this.#trails.lines);
      this.#scene.add(this.#trails.begin(count));
    }
    this.#dirty = true;
  }

  #setFormation(formation) {
    this.#marks.set(formation);
    this.#dirty = true;
  }

  async #loadWorld() {
    try {
      const world = await this.#station.call('world.describe');
      this.#worldName = world.name;
      if (world.trouble) toast(`world ${world.name} is not shown: ${world.trouble}`, 'bad');
      await this.#world.build(world, this.#station.roster);
      this.#dirty = true;
    } catch (error) { report(error); }
  }

  #received(fleet) {
    const now = performance.now();
    this.#motion.push(fleet.vehicles, now);
    if (fleet.movers.length) this.#movers.push(fleet.movers, now);
    this.#trails.push(fleet.vehicles, fleet.time);
    this.#dirty = true;
    if (!this.#framed && fleet.vehicles.length) {
      this.#framed = true;
      this.#frameAll();
    }
  }

  #draw(time) {
    if (this.#ended) return;
    requestAnimationFrame((next) => this.#draw(next));
    if (this.#software && time - this.#drawn < SOFTWARE_PERIOD) return;
    if (this.#renderer.domElement.width < 2) this.#resize();
    this.#controls.update();
    const begin = performance.now();
    if (!this.#dirty && !this.#moves(begin)) return;
    const settles = this.#motion.moves(begin) || this.#movers.moves(begin);
    if (this.#motion.rows) this.#update(begin, Math.min((time - this.#drawn) / 1000, 0.1));
    this.#drawn = time;
    this.#dirty = settles; // one more frame, at the end of the motion
    const middle = performance.now();
    this.#renderer.render(this.#scene, this.#camera);
    const end = performance.now();
    this.#writeNames();
    this.frames += 1;
    const { calls, triangles } = this.#renderer.info.render;
    this.costs.note(middle - begin + performance.now() - end, end - middle, calls, triangles, this.#now !== null && this.#vehicles.shown);
    this.#adaptDetail(time);
  }

  /** Tells whether something moves: vehicles between two frames, or rotors while time passes. */
  #moves(now) {
    if (this.#motion.moves(now) || this.#movers.moves(now)) return true;
    return this.#vehicles.anyArmed && this.#station.connected && this.#motion.silence(now) < STILL;
  }

  #update(now, seconds) {
    this.#now = this.#motion.now(now);
    this.#followOne();
    const distance = this.#camera.position.distanceTo(this.#controls.target);
    this.#vehicles.update(this.#now, seconds, this.#camera.position, distance);
    this.#marks.update(this.#now);
    if (this.#movers.rows) this.#world.move(this.#station.roster.movers, this.#movers.now(now));
  }

  /** Draws fewer pixels where the machine cannot keep up, and more again where it can. */
  #adaptDetail(time) {
    const span = time - this.#second.begin;
    this.#second.count += 1;
    if (span < 1000) return;
    const rate = (1000 * this.#second.count) / span;
    const before = this.#detail;
    if (this.#second.busy && rate < SLOW) this.#detail = Math.max(LEAST_DETAIL, 0.8 * before);
    else if (rate > FAST) this.#detail = Math.min(1, 1.1 * before);
    this.#second = { begin: time, count: 0, busy: this.#vehicles.anyArmed };
    if (this.#detail !== before) this.#resize();
  }

  #resize() {
    const { clientWidth: width, clientHeight: height } = this.#element;
    if (!width || !height) return;
    this.#renderer.setPixelRatio(this.#detail * Math.min(devicePixelRatio, this.#software ? 1 : 2));
    this.#renderer.setSize(width, height);
    this.#labels.resize(width, height);
    this.#camera.aspect = width / height;
    this.#camera.updateProjectionMatrix();
    this.#dirty = true;
  }

  #paint() {
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => new Color().setStyle(style.getPropertyValue(name).trim(), SRGBColorSpace);
    this.#scene.background = colour('--sky');
    this.#ground.material.color = colour('--earth');
    if (this.#grid) this.#scene.remove(this.#grid);
    this.#grid = new GridHelper(400, 80, colour('--soft'), colour('--soft'));
    this.#grid.rotation.x = Math.PI / 2;
    this.#grid.material.transparent = true;
    this.#grid.material.opacity = 0.35;
    this.#grid.material.depthWrite = false;
    this.#grid.renderOrder = -1;
    this.#scene.add(this.#grid);
    this.#dirty = true;
  }

  // ---- cameras

  /** Returns middle and radius of all vehicles, m. */
  #extent() {
    const rows = this.#motion.rows ?? [];
    const points = [];
    for (let i = 0; i < rows.length; i += COLUMNS) {
      if (!Number.isNaN(rows[i])) points.push(new Vector3(rows[i], rows[i + 1], rows[i + 2]));
    }
    const middle = points.reduce((sum, point) => sum.add(point), new Vector3()).divideScalar(points.length || 1);
    const radius = points.reduce((most, point) => Math.max(most, point.distanceTo(middle)), 3);
    return { middle, radius };
  }

  #frameAll() { this.#lookFrom(new Vector3(-0.55, -0.75, 0.55)); }

  #lookFrom(direction) {
    const { middle, radius } = this.#extent();
    this.#controls.target.copy(middle);
    this.#camera.position.copy(direction).normalize().multiplyScalar(2.6 * radius).add(middle);
    this.#controls.update();
    this.#dirty = true;
  }

  #toggleFollow() {
    const [name] = this.#station.selection.names;
    this.#follow = this.#follow ? null : name ?? null;
    if (!name && !this.#follow) toast('Select a vehicle to follow it.');
    this.followButton.classList.toggle('on', this.#follow !== null);
    if (this.#follow) {
      const place = this.#placeOf(this.#follow);
      if (place) this.#camera.position.copy(place).add(new Vector3(-3.5, -4, 2.5));
      if (place) this.#controls.target.copy(place);
    }
  }

  #followOne() {
    const place = this.#follow && this.#placeOf(this.#follow);
    if (!place) return;
    const shift = place.clone().sub(this.#controls.target);
    this.#controls.target.copy(place);
    this.#camera.position.add(shift);
  }

  #placeOf(name) {
    const i = (this.#numbers.get(name) ?? -1) * COLUMNS;
    return i >= 0 && !Number.isNaN(this.#now?.[i] ?? NaN) ? new Vector3(this.#now[i], this.#now[i + 1], this.#now[i + 2]) : null;
  }

  // ---- picking

  /** Returns where a vehicle is seen, px; null behind the camera. */
  screenPlace(name) {
    const place = this.#placeOf(name);
    if (!place) return null;
    const seen = place.project(this.#camera);
    if (seen.z > 1) return null;
    return [(0.5 + 0.5 * seen.x) * this.#labels.canvas.width, (0.5 - 0.5 * seen.y) * this.#labels.canvas.height];
  }

  #clicked(event) {
    const { left, top, width, height } = this.#renderer.domElement.getBoundingClientRect();
    const [x, y] = [event.clientX - left, event.clientY - top];
    if (this.#station.picking) {
      const ray = new Raycaster();
      ray.setFromCamera(new Vector2((2 * x) / width - 1, 1 - (2 * y) / height), this.#camera);
      const place = ray.ray.intersectPlane(new Plane(new Vector3(0, 0, 1), 0), new Vector3());
      if (place) this.#station.picking([place.x, place.y]);
      return;
    }
    let best = null;
    for (const { name } of this.#station.roster.vehicles) {
      const place = this.screenPlace(name);
      const gap = place ? Math.hypot(place[0] - x, place[1] - y) : Infinity;
      if (gap < PICK && gap < (best?.gap ?? Infinity)) best = { name, gap };
    }
    if (!best) return;
    if (event.shiftKey || event.ctrlKey) this.#station.selection.toggle(best.name);
    else this.#station.selection.set([best.name]);
  }

  #writeNames() {
    if (!this.#now) return;
    const { vehicles } = this.#station.roster;
    this.#seen.multiplyMatrices(this.#camera.projectionMatrix, this.#camera.matrixWorldInverse);
    this.#labels.draw(vehicles, this.#now, this.#seen.elements, vehicles.length > MOST_NAMES ? this.#isSelected : anyName);
  }

  #isSelected = (name) => this.#station.selection.has(name);
}

const anyName = () => true;

/** Tells whether the browser draws on the processor, where smooth edges cost most. */
function drawsInSoftware() {
  const context = document.createElement('canvas').getContext('webgl2');
  const info = context?.getExtension('WEBGL_debug_renderer_info');
  const name = info ? context.getParameter(info.UNMASKED_RENDERER_WEBGL) : '';
  context?.getExtension('WEBGL_lose_context')?.loseContext();
  return /swiftshader|llvmpipe|software/i.test(name);
}

function report(error) { toast(error.message, 'bad'); }

function mount(element, station) {
  const view = new View(element, station);
  station.view = view;
  return () => view.end();
}

export const panel = { name: 'scene', title: '3D', icon: '⬚', place: 'stage', mount };

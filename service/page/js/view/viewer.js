/**
 * The large view, which draws only after a change.
 *
 * Its canvas fires `drawn` after each picture, in the same task, and `turned` when the user has turned it.
 */

import * as THREE from "three";
import { OrbitControls } from "three/addons/OrbitControls.js";
import {
  VIEW,
  distanceTo,
  face,
  frame,
  geometryOf,
  litCamera,
  move,
  paint,
  sideOf,
  sphereOf,
} from "./scene.js";
import { BEHIND, colourOf, materials } from "./look.js";
import { Picker } from "./picker.js";
import { Stage } from "./stage.js";

const TURN = Math.PI / 24;
const SPEED = 4; // of a view that turns by itself: 15 s a turn
const LOWEST = Math.PI / 2; // angle of the camera from the vertical: never below the ground
const ROOM_FOR_TWO = 1.2; // the legend, which is often shown then, hides a corner
const ROOM = 1.08; // factor of the distance, for shapes that are larger than the reference

export class Viewer {
  #scheduled = false;
  #share = 1; // share of the height that is free for the shape
  #grounds = [];
  #back = 0; // times by which the camera has moved back for a second shape

  /** `margin`: pixels of the canvas's height below buttons and text. */
  constructor(canvas, margin) {
    this.canvas = canvas;
    this.margin = margin;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.scene = new THREE.Scene();
    this.camera = litCamera();
    /** The space of the camera, which a headset enters. */
    this.rig = new THREE.Group().add(this.camera);
    this.scene.add(this.rig);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.zoomToCursor = true;
    this.controls.maxPolarAngle = LOWEST;
    this.controls.addEventListener("change", () => this.draw());
    this.controls.addEventListener("end", () => this.#turned());
    /** Whether the view differs from the initial one. */
    this.turned = false;

    this.material = materials(this.renderer);
    this.normals = new THREE.MeshNormalMaterial(BEHIND);
    /** @type {THREE.Side} */
    this.side = THREE.FrontSide;
    this.worn = "own";
    /** A second shape in the same material, if there is one. @type {THREE.Mesh | null} */
    this.companion = null;
    /** @type {THREE.Mesh<THREE.BufferGeometry, THREE.Material>} */
    this.mesh = new THREE.Mesh(new THREE.BufferGeometry(), this.surface);
    const wires = new THREE.MeshBasicMaterial({
      wireframe: true,
      color: 0x1f2a37,
      transparent: true,
      opacity: 0.55,
    });
    this.wires = new THREE.Mesh(this.mesh.geometry, wires);
    this.picker = new Picker(canvas, this.camera, this.mesh);
    this.mesh.frustumCulled = this.wires.frustumCulled = false;
    // Not drawn while empty, because three.js would choose flat shading without normals, and keep it.
    this.mesh.visible = this.wires.visible = false;
    // Shown instead of the mesh if there are textures and no colours; the pointer still picks the mesh.
    this.skinned = new THREE.Mesh();
    this.skinned.frustumCulled = this.skinned.visible = false;
    this.stage = this.ground();
    this.scene.add(this.mesh, this.wires, this.skinned);
    this.recolour();
    this.geometries = {};

    new ResizeObserver(() => this.#resize()).observe(canvas.parentElement);
    this.#resize();
    canvas.addEventListener("keydown", (event) => this.#key(event));
    canvas.addEventListener("dblclick", () => this.focus());
    canvas.addEventListener("webglcontextrestored", () => this.draw());
  }

  /** Switch to a model, given its coarse reference; returns when the old model is removed. */
  open(reference) {
    for (const geometry of Object.values(this.geometries)) geometry.dispose();
    this.geometries = {};
    this.skin?.dispose();
    this.skin = null;
    this.skinned.visible = false;
    this.addMesh("coarse", reference);
    this.sphere = sphereOf(reference.vertices);
    this.reference = this.seen = reference.vertices;
    this.middle = this.sphere.center;
    this.stage.open(this.sphere);
    this.side = sideOf(reference.faces, reference.vertices.length / 3);
    face(this.normals, this.side);
    face(this.surface, this.side);
    this.resetView();
  }

  addMesh(name, { vertices, faces }) {
    this.geometries[name] = geometryOf(faces, vertices.length / 3);
  }

  /** Set materials and textures of one of the model's meshes. */
  dress(name, skin) {
    for (const material of skin.materials) face(material, this.side);
    this.skin = skin;
    this.skinOf = name;
    Object.assign(this.skinned, { geometry: skin.geometry, material: skin.materials });
    this.#wear();
    this.draw();
  }

  #wear() {
    const { skin, mesh } = this;
    if (!mesh.geometry.index) return; // no shape is shown yet
    const wears = Boolean(skin) && mesh.geometry === this.geometries[this.skinOf];
    this.skinned.visible = wears && this.worn === "own" && !this.coloured && mesh.material !== this.normals;
    mesh.visible = !this.skinned.visible;
    if (wears) skin.follow(mesh.geometry);
  }

  /** Show positions on one of the model's meshes, after a motion (Matrix4) if it is given. */
  show(name, positions, colours, placement) {
    const geometry = this.geometries[name];
    move(geometry, positions);
    paint(geometry, colours, this.base);
    this.mesh.geometry = this.wires.geometry = geometry;
    for (const mesh of [this.mesh, this.wires, this.skinned]) {
      mesh.matrixAutoUpdate = false;
      mesh.matrix.copy(placement ?? new THREE.Matrix4());
      mesh.updateMatrixWorld(true);
    }
    this.stage.under(positions, geometry.index.array, this.mesh.matrix);
    this.coloured = Boolean(colours);
    this.#wear();
    this.draw();
  }

  paint(colours) {
    paint(this.mesh.geometry, colours, this.base);
    this.coloured = Boolean(colours);
    this.#wear();
    this.draw();
  }

  /** The material of the surface, drawn on the sides that the model needs. */
  get surface() {
    const material = this.material(this.worn);
    return material.side === this.side ? material : face(material, this.side);
  }

  /** The colour of the surface where it has no other. */
  get base() {
    return colourOf(this.worn);
  }

  /** Set the material, whether lines are shown, and whether colours show normals. */
  style({ wireframe, normals, material, colour }) {
    this.wires.visible = wireframe;
    this.worn = colour === "none" ? material : "clay"; // colours are read on a matt surface
    this.mesh.material = normals ? this.normals : this.surface;
    if (this.companion) this.cover(this.companion);
    this.#wear();
    this.draw();
  }

  /** Give a second shape the surface of the first. */
  cover(mesh) {
    this.companion = mesh;
    mesh.material = this.surface;
    if (mesh.geometry.attributes.color) paint(mesh.geometry, null, this.base);
  }

  /** Leave the wheel to the page around this one until the view has the focus. */
  shareWheel() {
    const choose = ({ ctrlKey }) => {
      this.controls.enableZoom = ctrlKey || document.activeElement === this.canvas;
    };
    this.canvas.addEventListener("wheel", choose, { capture: true, passive: true });
  }

  /** Whether the view turns by itself. */
  get spins() {
    return this.controls.autoRotate;
  }

  /** Start or stop to turn by itself. */
  spin(on) {
    if (this.spins && !on) this.#turned();
    Object.assign(this.controls, { autoRotate: on, autoRotateSpeed: SPEED });
    let before = performance.now();
    const step = (now) => {
      if (!this.spins) return;
      this.controls.update(Math.max(now - before, 0) / 1000);
      before = now;
      requestAnimationFrame(step);
    };
    if (on) requestAnimationFrame(step);
  }

  /** Add a ground below a shape. */
  ground() {
    const made = new Stage();
    this.#grounds.push(made);
    this.scene.add(made);
    return made;
  }

  /** Set the colours of the theme. */
  recolour() {
    for (const ground of this.#grounds) ground.colour = getComputedStyle(this.canvas).color;
    this.draw();
  }

  #turned() {
    this.turned = true;
    this.canvas.dispatchEvent(new Event("turned"));
  }

  resetView() {
    this.turned = false;
    this.#back = 0;
    frame(this.camera, { center: this.middle, radius: this.sphere.radius }, this.#distance);
    this.controls.target.copy(this.middle);
    this.controls.minDistance = 0.2 * this.sphere.radius;
    this.controls.maxDistance = 20 * this.sphere.radius;
    this.controls.update();
    this.draw();
  }

  /** Fill the view with the shape, from the direction of the view. */
  focus() {
    if (!this.mesh.geometry.index) return; // no shape is shown yet
    const { positions } = this.picker;
    const middle = sphereOf(positions).center;
    const back = this.camera.position.clone().sub(this.controls.target).normalize();
    const distance = ROOM * distanceTo(this.camera, positions, middle, this.#share, back);
    this.controls.target.copy(middle);
    this.camera.position.copy(middle).addScaledVector(back, distance);
    this.controls.update();
    this.draw();
    this.#turned();
  }

  /**
   * Show positions (3V numbers) beside the reference in the view; null shows the reference alone. The
   * direction of the view stays; the camera's position stays, too, if it is `given`.
   */
  makeRoom(positions, given = false) {
    const { middle } = this;
    const before = this.#distance;
    this.seen = positions ? joined(this.reference, positions) : this.reference;
    this.middle = sphereOf(this.seen).center;
    if (!this.turned) this.resetView();
    else if (!given) {
      // Both shapes fit, however near the camera was; afterwards the camera returns to its distance.
      const now = this.#distance;
      const away = this.camera.position.distanceTo(this.controls.target);
      const times = positions
        ? Math.max(now / before, now / away)
        : this.#back
          ? 1 / this.#back
          : now / before;
      this.#back = positions ? (this.#back || 1) * times : 0;
      this.#move(this.middle.clone().sub(middle), times);
      // The address may be older than the shape.
      this.canvas.dispatchEvent(new Event("turned"));
    }
  }

  /** Move the target of the camera, and scale its distance. */
  #move(by, times) {
    const { target } = this.controls;
    const offset = this.camera.position.clone().sub(target).multiplyScalar(times);
    target.add(by);
    this.camera.position.copy(target).add(offset);
    this.controls.update();
  }

  /** Return the distance at which the shapes fill the free part of the picture. */
  get #distance() {
    const from = this.turned ? this.camera.position.clone().sub(this.controls.target) : VIEW;
    const room = this.seen === this.reference ? ROOM : ROOM_FOR_TWO;
    return room * distanceTo(this.camera, this.seen, this.middle, this.#share, from);
  }

  /** Position and target of the camera, as six numbers. */
  get view() {
    return [...this.camera.position.toArray(), ...this.controls.target.toArray()];
  }

  set view(numbers) {
    this.camera.position.fromArray(numbers);
    this.controls.target.fromArray(numbers, 3);
    this.controls.update();
    this.draw();
  }

  /** Set a view, turned by an angle (radians) about the vertical axis. */
  turn(view, angle) {
    const [position, target] = [new THREE.Vector3().fromArray(view), new THREE.Vector3().fromArray(view, 3)];
    const there = position.sub(target).applyAxisAngle(this.camera.up, angle).add(target);
    this.view = [...there.toArray(), ...target.toArray()];
  }

  /** Draw with the next frame of the screen. */
  draw() {
    if (this.#scheduled || this.renderer.xr.isPresenting) return; // a headset draws by itself
    this.#scheduled = true;
    requestAnimationFrame(() => {
      this.#scheduled = false;
      this.render();
    });
  }

  /** Draw now. */
  render() {
    this.renderer.render(this.scene, this.camera);
    this.canvas.dispatchEvent(new Event("drawn"));
  }

  /** Call a function while the canvas is opaque, because files lack the page behind it. */
  async opaquely(work) {
    this.scene.background = new THREE.Color(getComputedStyle(this.canvas.parentElement).backgroundColor);
    try {
      return await work();
    } finally {
      this.scene.background = null;
      this.draw();
    }
  }

  #resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height || this.renderer.xr.isPresenting) return;
    const before = this.reference && this.#distance;
    this.camera.aspect = width / height;
    this.#share = Math.max(1 - this.margin / height, 0.4);
    this.renderer.setSize(width, height, false);
    // The distance follows the size of the window, so that it shows the same.
    if (before) this.#move(new THREE.Vector3(), this.#distance / before);
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  #key(event) {
    const turns = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const zooms = { "+": 1 / 1.12, "=": 1 / 1.12, "-": 1.12 };
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const offset = this.camera.position.clone().sub(this.controls.target);
    if (event.key in turns) {
      const spherical = new THREE.Spherical().setFromVector3(offset);
      spherical.theta += TURN * turns[event.key][0];
      spherical.phi += TURN * turns[event.key][1];
      spherical.phi = Math.min(spherical.phi, LOWEST);
      offset.setFromSpherical(spherical.makeSafe());
    } else if (event.key in zooms) {
      offset.multiplyScalar(zooms[event.key]);
    } else if (event.key === "0" || event.key === "Home") {
      this.resetView();
      this.canvas.dispatchEvent(new Event("turned")); // the address forgets the view
      event.preventDefault();
      return;
    } else return;
    event.preventDefault();
    this.camera.position.copy(this.controls.target).add(offset);
    this.controls.update();
    this.draw();
    this.#turned();
  }
}

function joined(a, b) {
  const both = new Float32Array(a.length + b.length);
  both.set(a);
  both.set(b, a.length);
  return both;
}

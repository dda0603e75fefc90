/** Materials, light and ground of the large view, and the controls that choose them. */

import * as THREE from "three";
import { find } from "../dom.js";
import { Headset } from "./headset.js";
import { BASE, illuminate } from "./scene.js";

const WHITE = new THREE.Color(0xffffff);
/** Colours of surfaces without colours of their own. */
const COLOURS = {
  clay: BASE,
  skin: new THREE.Color(0xe3b094),
  metal: new THREE.Color(0xc8ccd2),
  matcap: WHITE,
};

/** Return the colour under a material; a file's own material has the clay's where it is missing. */
export const colourOf = (material) => COLOURS[material] ?? BASE;

/** Slightly farther from the camera, so that lines on the surface don't flicker. */
export const BEHIND = { polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 };
const shared = { ...BEHIND, vertexColors: true };
const MAKERS = {
  clay: () => new THREE.MeshStandardMaterial({ ...shared, roughness: 0.8 }),
  // A reddish glow stands for light that leaves skin beside the place where it entered.
  skin: () =>
    new THREE.MeshStandardMaterial({
      ...shared,
      roughness: 0.52,
      emissive: 0x5a1c10,
      emissiveIntensity: 0.22,
    }),
  metal: (renderer) =>
    new THREE.MeshStandardMaterial({
      ...shared,
      roughness: 0.3,
      metalness: 1,
      envMap: surroundings(renderer),
    }),
  matcap: () => new THREE.MeshMatcapMaterial({ ...shared, matcap: wax() }),
};

/** Return a function that makes each material once. */
export function materials(renderer) {
  const made = {};
  return (name) =>
    (made[name in MAKERS ? name : "clay"] ??= MAKERS[name in MAKERS ? name : "clay"](renderer));
}

/** Return a room with bright windows, which metal reflects. */
function surroundings(renderer) {
  const room = new THREE.Scene();
  room.background = new THREE.Color(0x2b3138);
  const pane = (brightness, x, y, z, size) => {
    const material = new THREE.MeshBasicMaterial({ side: THREE.DoubleSide });
    material.color.setScalar(brightness);
    const made = new THREE.Mesh(new THREE.PlaneGeometry(size, size), material);
    made.position.set(x, y, z);
    made.lookAt(0, 0, 0);
    room.add(made);
  };
  pane(6, -4, 4, 4, 4);
  pane(3, 5, 2, 2, 3);
  pane(5, 2, 3, -5, 3);
  pane(2.5, 0, 6, 0, 5);
  pane(0.5, 0, -5, 0, 9);
  const maker = new THREE.PMREMGenerator(renderer);
  const { texture } = maker.fromScene(room, 0.03);
  maker.dispose();
  return texture;
}

/** Return a picture of a sphere of wax, from which matcap takes the colour of each direction. */
function wax() {
  const size = 128;
  const pixels = new Uint8Array(4 * size * size);
  const [dark, middle, light] = [0x3d1512, 0xb4553f, 0xffdcc8].map((hex) => new THREE.Color(hex));
  const key = new THREE.Vector3(-0.5, 0.65, 0.6).normalize();
  const [normal, colour] = [new THREE.Vector3(), new THREE.Color()];
  for (let i = 0; i < size * size; i += 1) {
    normal.set(((i % size) + 0.5) / (size / 2) - 1, (Math.floor(i / size) + 0.5) / (size / 2) - 1, 0);
    normal.z = Math.sqrt(Math.max(1 - normal.lengthSq(), 0));
    const lit = 0.5 + 0.5 * normal.normalize().dot(key);
    colour.lerpColors(dark, middle, THREE.MathUtils.smoothstep(lit, 0.1, 0.75));
    colour.lerp(light, 0.55 * lit ** 6 + 0.45 * lit ** 60 + 0.3 * (1 - normal.z) ** 4);
    colour.convertLinearToSRGB();
    pixels.set([255 * colour.r, 255 * colour.g, 255 * colour.b, 255], 4 * i);
  }
  const texture = new THREE.DataTexture(pixels, size, size);
  Object.assign(texture, { colorSpace: THREE.SRGBColorSpace, needsUpdate: true });
  texture.magFilter = texture.minFilter = THREE.LinearFilter;
  return texture;
}

/** The buttons of the stage that change how the shape is seen. */
export class Look {
  /** @param {import("../store.js").Page} store */
  constructor(store, viewer, stage) {
    this.store = store;
    this.viewer = viewer;
    this.#choice("material");
    this.#choice("light");
    const ground = find("#ground");
    ground.addEventListener("change", () => store.set({ ground: ground.checked }));
    store.on(["ground"], () => {
      ground.checked = viewer.stage.visible = store.ground;
      viewer.draw();
    });
    ground.checked = store.ground;
    store.on(["light"], () => {
      illuminate(viewer.camera, store.light);
      viewer.draw();
    });
    this.#turntable(find("#spin"));
    this.#fullScreen(find("#full-screen"), stage);
    new Headset(viewer, find("#headset"));
  }

  /** @param {"material" | "light"} key */
  #choice(key) {
    /** @type {NodeListOf<any>} */
    const radios = document.querySelectorAll(`[name=${key}]`);
    const show = () => {
      const { hasOwn } = this.store;
      const chosen = this.store[key];
      find("#own").hidden = !hasOwn;
      const shown = chosen === "own" && !hasOwn ? "clay" : chosen;
      for (const radio of radios) radio.checked = radio.value === shown;
    };
    for (const radio of radios)
      radio.addEventListener("change", () => this.store.set({ [key]: radio.value }));
    this.store.on([key, "hasOwn"], show);
    show();
  }

  /** Turn until the user touches the view. */
  #turntable(button) {
    const spin = (on) => {
      button.setAttribute("aria-pressed", String(on));
      this.viewer.spin(on);
    };
    spin(false);
    button.addEventListener("click", () => spin(!this.viewer.spins));
    for (const touch of ["pointerdown", "wheel", "keydown"]) {
      this.viewer.canvas.addEventListener(touch, () => this.viewer.spins && spin(false), { passive: true });
    }
    find("#reset-view").addEventListener("click", () => spin(false));
  }

  #fullScreen(button, stage) {
    button.hidden = !document.fullscreenEnabled;
    const isFull = () => document.fullscreenElement === stage;
    const show = () => button.setAttribute("aria-pressed", String(isFull()));
    show();
    button.addEventListener("click", () =>
      isFull() ? document.exitFullscreen() : stage.requestFullscreen(),
    );
    stage.addEventListener("fullscreenchange", show);
  }
}

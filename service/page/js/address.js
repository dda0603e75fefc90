/** Reads and writes the state of the page in the part of its address after the #. */

import { Matrix4, Quaternion, Vector3 } from "three";
import { codeIn } from "./server/space.js";
import { OTHER } from "./view/colouring.js";

const COLOURS = ["stretch", "bending", "distance"];
const FLAGS = ["wireframe", "normals", "loop"];
const MATERIALS = ["own", "clay", "skin", "metal", "matcap"];
const LIGHTS = ["studio", "soft", "side"];
const number = (value) => String(Number(value.toFixed(5)));
const list = (numbers) => numbers.map(number).join(",");
const unlist = (text) => text.split(",").map(Number);

/** Return the part of the address for the store. */
export function toHash(store, view) {
  const parts = new URLSearchParams({ model: store.model.name, z: list(store.code) });
  const flags = FLAGS.filter((flag) => store[flag]);
  if (!store.fine) flags.push("coarse");
  if (!store.ground) flags.push("bare");
  if (flags.length) parts.set("show", flags.join(","));
  if (store.locked.some(Boolean))
    parts.set("locked", store.locked.flatMap((is, k) => (is ? [k] : [])).join(","));
  if (store.keyframes.length) parts.set("keys", store.keyframes.map(list).join(";"));
  if (store.beyond) parts.set("beyond", number(store.beyond));
  if (store.seconds) parts.set("seconds", number(store.seconds));
  if (store.easing !== "even") parts.set("easing", store.easing);
  if (COLOURS.includes(store.colour)) parts.set("colour", store.colour);
  if (store.material !== "own" || store.light !== "studio")
    parts.set("look", `${store.material},${store.light}`);
  if (store.other) parts.set("other", list(store.other));
  if (store.against !== -1) parts.set("against", store.against);
  if (store.pins.length) parts.set("pins", store.pins.map(fromPin).join(";"));
  if (store.placement) parts.set("place", list(fromPlacement(store.placement)));
  if (view) parts.set("view", list(view));
  return `#${parts.toString().replaceAll("%2C", ",").replaceAll("%3B", ";")}`;
}

const fromPin = ({ mesh, vertex, position }) => [mesh, vertex, list(position.toArray())].join(",");

/** Read a pin. Whether the mesh has its vertex is checked once the mesh is loaded. */
function toPin(text) {
  const [mesh, ...rest] = text.split(",");
  const [vertex, ...position] = rest.map(Number);
  const isPoint = position.length === 3 && position.every(Number.isFinite);
  return isPoint && Number.isInteger(vertex) && vertex >= 0
    ? [{ mesh, vertex, position: new Vector3(...position) }]
    : [];
}

/** Return a motion as the image of the origin and a quaternion. */
function fromPlacement(placement) {
  const [position, rotation] = [new Vector3(), new Quaternion()];
  placement.decompose(position, rotation, new Vector3());
  return [...position.toArray(), ...rotation.toArray()];
}

function toPlacement(numbers) {
  const rotation = new Quaternion(...numbers.slice(3));
  if (numbers.length !== 7 || !numbers.every(Number.isFinite) || rotation.length() === 0) return null;
  return new Matrix4().compose(new Vector3(...numbers), rotation.normalize(), new Vector3(1, 1, 1));
}

/**
 * Read an address, without the parts that are invalid for the model.
 * @returns {{model?: any, missing?: string, code?: number[], keyframes?: number[][], locked?: boolean[],
 *   view?: number[], pins?: import("./shape/pull.js").Pin[], state?: Partial<import("./store.js").State>}}
 */
export function fromHash(hash, models) {
  const parts = new URLSearchParams(hash.replace(/^#/, ""));
  const model = models.find(({ name }) => name === parts.get("model"));
  if (!model) return { missing: parts.get("model") };
  const m = model.latent_dimension;
  const keyframes = (parts.get("keys") ?? "").split(";").flatMap((text) => {
    const code = codeIn(text, m);
    return code ? [code] : [];
  });
  const flags = (parts.get("show") ?? "").split(",");
  const locked = (parts.get("locked") ?? "").split(",").filter(Boolean).map(Number);
  const against = Number(parts.get("against") ?? -1);
  const other = codeIn(parts.get("other"), m);
  const isThere =
    against === OTHER ? Boolean(other) : Number.isInteger(against) && against < keyframes.length;
  const view = unlist(parts.get("view") ?? "");
  const beyond = Number(parts.get("beyond"));
  const seconds = Number(parts.get("seconds"));
  const colour = parts.get("colour");
  const [material, light] = (parts.get("look") ?? "").split(",");
  return {
    model,
    code: codeIn(parts.get("z"), m),
    keyframes,
    locked: Array.from({ length: m }, (_, k) => locked.includes(k)),
    pins: (parts.get("pins") ?? "").split(";").flatMap(toPin),
    view: view.length === 6 && view.every(Number.isFinite) ? view : null,
    state: {
      placement: toPlacement(unlist(parts.get("place") ?? "")),
      ...Object.fromEntries(FLAGS.map((flag) => [flag, flags.includes(flag)])),
      fine: !flags.includes("coarse"),
      ground: !flags.includes("bare"),
      material: MATERIALS.includes(material) ? material : "own",
      light: LIGHTS.includes(light) ? light : "studio",
      colour: COLOURS.includes(colour) ? colour : "none",
      against: isThere ? Math.max(against, OTHER) : -1,
      other,
      seconds: seconds >= 0.5 && seconds <= 120 ? seconds : null,
      easing: parts.get("easing") === "soft" ? "soft" : "even",
      beyond: beyond > 0 && beyond <= 1 ? beyond : 0,
    },
  };
}

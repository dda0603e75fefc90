/** Puts the page together: one store, and the parts that show or change its values. */

import { fromHash, toHash } from "./address.js";
import { element, find, toggle, within } from "./dom.js";
import { Hand } from "./hand.js";
import { History } from "./history.js";
import { always, here } from "./memory.js";
import { report, reporting, say } from "./messages.js";
import { sheet } from "./sheet.js";
import { Store } from "./store.js";
import { tabs } from "./tabs.js";
import { theme } from "./theme.js";
import { Path } from "./path/path.js";
import { Strip } from "./path/strip.js";
import { Ghost } from "./scan/ghost.js";
import { Reader } from "./scan/reader.js";
import * as api from "./server/api.js";
import { listed, preferred } from "./server/first.js";
import { ShapeLoop } from "./server/shape-loop.js";
import { LatentSpace, sameCode } from "./server/space.js";
import { openCard } from "./shape/card.js";
import { Names, namesOf } from "./shape/names.js";
import { OnScreen } from "./shape/on-screen.js";
import { Pins } from "./shape/pins.js";
import { Pull } from "./shape/pull.js";
import { Sliders } from "./shape/sliders.js";
import { Beside } from "./shelf/beside.js";
import { Blend } from "./shelf/blend.js";
import { Shelf } from "./shelf/shelf.js";
import { copy, Files } from "./show/files.js";
import { Welcome } from "./show/welcome.js";
import { Colouring } from "./view/colouring.js";
import { Look } from "./view/look.js";
import { Modes } from "./view/modes.js";
import { Pictures } from "./view/pictures.js";
import { Pose } from "./view/pose.js";
import { Skin } from "./view/skin.js";
import { Viewer } from "./view/viewer.js";

document.documentElement.classList.add("arrived");

/** @type {import("./store.js").Page} */
const store = /** @type {any} */ (
  new Store({
    model: null,
    space: null,
    names: null,
    references: {},
    hasFine: false,
    pose: null,
    code: null,
    locked: [],
    placement: null,
    moving: false,
    playing: false,
    shape: null,
    failed: null,
    keyframes: [],
    loop: false,
    beyond: 0,
    seconds: null,
    easing: "even",
    usual: null,
    colour: "none",
    against: -1,
    other: null,
    highlight: null,
    regions: null,
    repaint: null,
    motions: null,
    material: "own",
    hasOwn: false,
    light: "studio",
    ground: true,
    wireframe: false,
    normals: false,
    fine: true,
    pull: false,
    pins: [],
    hover: null,
    solving: null,
    scan: null,
    found: null,
    ghost: true,
  })
);

const embedded = document.documentElement.classList.contains("embed");
const viewer = new Viewer(find("#canvas"), embedded ? 24 : 100);
if (embedded) viewer.shareWheel();
const pictures = new Pictures();
const hand = new Hand(store);
const sliders = new Sliders(store, hand, find("#factors"));
const modes = new Modes(store, sliders, pictures);
const colouring = new Colouring(store, { legend: find("#legend"), against: find("#against") });
const path = new Path(store, pictures, {
  list: find("#keyframes"),
  add: find("#add-keyframe"),
  play: find("#play"),
  loop: find("#loop"),
  beyond: find("#beyond"),
  seconds: find("#seconds"),
  easing: find("#easing"),
  timeline: find("#timeline"),
  time: find("#time"),
  status: find("#path-status"),
});
new Strip(store, pictures, { button: find("#draw-strip"), table: find("#strip") });
new Shelf(store, pictures, { list: find("#shelf"), add: find("#keep-shape") });
new Beside(store, viewer);
new Blend(store, hand, find("#blend"));
new Names(store, { dialog: find("#names"), button: find("#name") });
new History(store, { undo: find("#undo"), redo: find("#redo") });
new Files(store, path, viewer, find("#tab-files"));
new Ghost(store, viewer);
new Reader(store, {
  box: find("#verdict"),
  input: find("#mesh-file"),
  readAs: find("#read-as"),
  ownScale: find("#own-scale"),
  stage: find(".stage"),
});
new Pins(store, viewer, new Pull(store, viewer), {
  layer: find("#pins"),
  threads: find("#threads"),
  hover: find("#hover"),
  clear: find("#clear-pins"),
});
new ShapeLoop(store);
new OnScreen(store, viewer.canvas, find(".stage"));
const welcome = new Welcome(store, find("#welcome"));
tabs(find("[role=tablist]"));
sheet(find("#sheet"), find("main"));
new Look(store, viewer, find(".stage"));

// The shape and its colours.
store.on(["shape"], () => {
  if (!store.shape) return;
  const { mesh, positions, placement, motion } = store.shape;
  viewer.show(
    mesh,
    positions,
    colouring.of(store.shape),
    placement ? placement.clone().multiply(motion) : motion,
  );
});
store.on(["wireframe", "normals", "material", "colour"], () => viewer.style(store));
store.on(["colour", "against", "highlight", "regions", "repaint", "material"], () => {
  if (store.shape) viewer.paint(colouring.of(store.shape));
});
viewer.canvas.addEventListener("drawn", () => {
  find("#reset-view").hidden = !viewer.turned;
});

// Switches.
for (const key of ["wireframe", "normals", "fine", "pull"]) toggle(find(`#${key}`), store, key);
find("#reset-view").addEventListener("click", () => {
  viewer.resetView();
  viewer.canvas.focus(); // the button goes
  remember();
});
/** @type {NodeListOf<any>} */
const radios = document.querySelectorAll("[name=colour]");
for (const radio of radios) {
  radio.addEventListener("change", () => store.set({ colour: radio.value }));
  store.on(["colour"], () => {
    radio.checked = radio.value === store.colour;
  });
}
store.on(["found", "code"], () => {
  const { found, code, colour } = store;
  const isShown = Boolean(found && code && sameCode(found.code, code));
  find("#sure").hidden = !isShown;
  if (!isShown && colour === "spread") store.set({ colour: "none" });
});
theme(find("#theme"), viewer);

// Codes that do not come from the sliders.
const take = (code) => {
  const { locked, space } = store;
  store.set({ code: space.wrapAll(code).map((value, k) => (locked[k] ? store.code[k] : value)) });
};
const seed = find("#seed");
const distribution = find("#distribution");
seed.value = here.kept("seed") ?? 0;
distribution.value = here.kept("distribution") ?? "population";
const draw = reporting(async () => {
  if (store.locked.every(Boolean)) throw new Error("All sliders are locked. Unlock at least one.");
  here.keep("seed", seed.value);
  here.keep("distribution", distribution.value);
  // The Gaussian of the population has no bounds, but what the page calls likely must not be outside.
  const { model, space } = store;
  const code = space.clampAll(await api.sample(model, Number(seed.value), distribution.value));
  if (store.space === space) take(code);
});
distribution.addEventListener("change", draw);
find("#random").addEventListener("click", () => {
  seed.value = (within(seed) + 1) % (Number(seed.max) + 1);
  draw();
});
seed.addEventListener("change", () => {
  if (seed.value !== "") draw(within(seed));
});
find("#about").addEventListener(
  "click",
  reporting(() => openCard(find("#card"), store.model)),
);
find("#share").addEventListener("click", () => {
  remember();
  copy(location.href, "the address of this shape");
});

// Models.
const picker = find("#model");
let models = [];
let opening; // the last model that was asked for
picker.addEventListener(
  "change",
  reporting(async () => {
    try {
      const model = models.find(({ name }) => name === picker.value);
      if (model === store.model) opening = store.space;
      else await openModel({ model });
    } catch (error) {
      picker.value = store.model.name; // the model that is still shown
      throw error;
    }
  }),
);

/** Return whether a pin's mesh has its vertex. */
const isThere = ({ mesh, vertex }) => 3 * vertex < store.references[mesh]?.vertices.length;

/**
 * Apply an address to the model that is shown.
 * @param {ReturnType<typeof fromHash>} asked
 */
function goTo({ code, keyframes, locked, view, pins, state }) {
  if (view) Object.assign(viewer, { view, turned: true });
  const { model, space } = store;
  opening = space;
  picker.value = model.name; // another one may be on its way
  const wrapped = space.wrapAll(code ?? space.home);
  store.set({ playing: false, code: wrapped, keyframes, locked, pins: pins.filter(isThere), ...state });
}

/**
 * Switch to a model, at its home code or as an address says.
 * @param {ReturnType<typeof fromHash>} asked
 */
async function openModel({ model, code, keyframes = [], locked, view, pins = [], state = {} }) {
  const space = new LatentSpace(model);
  const wrapped = space.wrapAll(code ?? space.home);
  if (store.model) api.ask(model, wrapped); // the first model's answers are under way
  opening = space;
  const coarse = await api.reference(model, "coarse");
  if (opening !== space) return; // the user may have left a model and come back to it
  picker.value = model.name;
  store.set({ shape: null, playing: false, placement: null, pins: [], hover: null });
  viewer.open(coarse);
  pictures.open(coarse);
  if (view) Object.assign(viewer, { view, turned: true });
  store.set({
    model,
    space,
    names: namesOf(model),
    hasOwn: false,
    references: { coarse },
    hasFine: false,
    pose: null,
    regions: null,
    usual: null,
    highlight: null,
    code: wrapped,
    locked: locked ?? space.home.map(() => false),
    keyframes,
    against: -1,
    other: null,
    ...state,
  });
  for (const part of document.querySelectorAll("[inert]")) part.removeAttribute("inert");
  find("#canvas").setAttribute("aria-label", `${model.title}, the shape of the code that the sliders give`);
  document.title = `${model.title} · shapespace`;
  const fine = await api.reference(model, "fine");
  if (store.space !== space) return;
  if (fine.vertices.length !== coarse.vertices.length) {
    viewer.addMesh("fine", fine);
    store.set({
      references: { coarse, fine },
      pose: new Pose(coarse.vertices, fine.vertices),
      hasFine: true,
    });
  }
  find("#fine").disabled = !store.hasFine;
  const held = pins.filter(isThere);
  if (held.length && store.pins.length === 0) store.set({ pins: held });
  if (model.surface?.materials.some(({ texture }) => texture)) {
    try {
      const skin = await Skin.of(await api.textured(model));
      if (store.space !== space) skin.dispose();
      else {
        viewer.dress(store.hasFine ? "fine" : "coarse", skin);
        store.set({ hasOwn: true });
      }
    } catch (error) {
      // only the appearance is missing without it
      report(error);
    }
    if (store.space !== space) return;
  }
  if (embedded) return;
  welcome.play();
  await modes.draw();
}

// The address. Each finished movement to another shape is an entry of the browser's history.
let soon = 0;
let remembered = null;
function remember() {
  clearTimeout(soon);
  if (!store.model || store.playing || store.moving || welcome.alone) return;
  const hash = toHash(store, viewer.turned ? viewer.view : null);
  const shape = `${store.model.name} ${store.code}`;
  const isNext = remembered !== null && remembered !== shape && !embedded;
  if (hash !== location.hash) history[isNext ? "pushState" : "replaceState"](null, "", hash);
  remembered = shape;
  find("#whole").href = location.pathname + hash;
}
const rememberSoon = () => {
  clearTimeout(soon);
  soon = setTimeout(remember, 250);
};
store.on(
  [
    "model",
    "code",
    "locked",
    "keyframes",
    "loop",
    "beyond",
    "seconds",
    "easing",
    "colour",
    "against",
    "other",
    "wireframe",
    "normals",
    "material",
    "light",
    "ground",
    "fine",
    "moving",
    "playing",
    "pins",
    "placement",
  ],
  rememberSoon,
);
viewer.canvas.addEventListener("turned", rememberSoon);
addEventListener("hashchange", reporting(restore));

async function restore({ newURL = location.href } = {}) {
  const asked = fromHash(new URL(newURL).hash, models);
  remembered = null;
  if (!asked.code && !embedded) welcome.open();
  if (asked.model && asked.model === store.model) return goTo(asked);
  if (asked.model) return openModel(asked);
  const model = preferred(models);
  if (asked.missing) {
    const instead =
      `The address asks for the model ${asked.missing}, which is not served here. ` +
      `This is ${model.title}.`;
    say(instead, { kind: "error", key: "missing" });
  }
  return openModel({ model });
}

find("#key form").addEventListener("submit", () => {
  api.useKey(find("#key input").value);
  location.reload();
});

try {
  models = await listed;
  picker.replaceChildren(
    ...models.map(({ name, title }) => element("option", { value: name, textContent: title })),
  );
  if (models.length === 0)
    throw new Error("No model is served. Put a bundle into the models folder and start again.");
  await restore();
} catch (error) {
  find(".stage").ariaBusy = "false";
  if (error.status === 401) find("#key").showModal();
  else report(error);
}

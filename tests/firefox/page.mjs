// The page in Firefox: `node page.mjs FIREFOX URL FOLDER`, with an empty folder for what it downloads.
// Prints a line for each user action tested; exits 1 if one has a wrong result.

import { readdirSync, readFileSync } from "node:fs";
import { join } from "node:path";
import { setTimeout as sleep } from "node:timers/promises";
import puppeteer from "puppeteer-core";

const PATIENCE = 120_000; // ms; the machine may be busy with other things
const [executablePath, url, folder] = process.argv.slice(2);

const browser = await puppeteer.launch({
  browser: "firefox",
  executablePath,
  headless: false, // a headless Firefox has no WebGL in software
  extraPrefsFirefox: {
    "webgl.force-enabled": true,
    "browser.download.folderList": 2,
    "browser.download.dir": folder,
    "browser.download.alwaysOpenPanel": false, // the panel would take the focus from the page
    "browser.helperApps.neverAsk.saveToDisk": "model/gltf-binary,application/octet-stream",
    "ui.prefersReducedMotion": 1,
  },
});
const page = await browser.newPage();
const complaints = [];
page.on("pageerror", (error) => complaints.push(error.message));
page.on("console", (message) => message.type() === "error" && complaints.push(message.text()));

async function eventually(what) {
  for (const end = Date.now() + PATIENCE; Date.now() < end; await sleep(50)) {
    const value = await what();
    if (value) return value;
  }
  throw new Error(`the condition did not become true in time: ${what}`);
}

const code = () =>
  new URLSearchParams(new URL(page.url()).hash.slice(1)).get("z")?.split(",").map(Number) ?? [];
const near = (a, b) => a.length === b.length && a.every((x, k) => Math.abs(x - b[k]) < 2e-3);
const rests = () => page.$eval(".stage", (stage) => stage.dataset.quality === "full");
const tab = (name) => page.click(`#to-${name}`);
const picture = () => page.screenshot({ encoding: "base64" });

/** Drag a coordinate's slider with the mouse, from its present position to a share of its length. */
async function drag(k, share) {
  const slider = await page.evaluateHandle((index) => {
    const row = document.querySelectorAll(".coordinate")[index];
    row.closest("details").open = true;
    row.scrollIntoView({ block: "center" });
    return row.querySelector("input[type=range]");
  }, k);
  const { x, y, width, height } = await slider.boundingBox();
  const at = await slider.evaluate(({ min, max, value }) => (value - min) / (max - min));
  const along = (part) => x + 8 + part * (width - 16); // the track less the thumb's width
  await page.mouse.move(along(at), y + height / 2);
  await page.mouse.down();
  for (const part of [0.3, 0.6, 1]) await page.mouse.move(along(at + part * (share - at)), y + height / 2);
  await page.mouse.up();
}

async function downloaded(button) {
  const before = new Set(readdirSync(folder));
  await page.click(button);
  const name = await eventually(() => {
    const names = readdirSync(folder);
    return !names.some((each) => each.endsWith(".part")) && names.find((each) => !before.has(each));
  });
  return join(folder, name);
}

let file;
const STEPS = {
  "the first shape": async () => {
    await page.goto(url);
    await eventually(rests);
    const drawn = await page.$eval("#canvas", (canvas) => canvas.width * canvas.height > 0);
    return drawn && (await page.$eval("#without", (section) => getComputedStyle(section).display === "none"));
  },
  "a slider moves the shape, and the address tells": async () => {
    const before = await picture();
    await drag(4, 0.9);
    await eventually(() => code()[4] > 0.3 && code().every((value, k) => k === 4 || value === 0));
    await eventually(rests);
    return before !== (await picture());
  },
  "undo, which takes back the whole drag, and redo": async () => {
    const then = code();
    await page.click("#undo");
    await eventually(() => code().every((value) => value === 0));
    await page.click("#redo");
    return eventually(() => near(code(), then));
  },
  "the shape as GLB": async () => {
    await tab("files");
    file = await downloaded("#download");
    return readFileSync(file).subarray(0, 4).toString() === "glTF";
  },
  "a file comes back as its code": async () => {
    const then = code();
    await tab("shape");
    await page.click("#reset-all");
    await eventually(() => !near(code(), then));
    await tab("files");
    await (await page.$("#mesh-file")).uploadFile(file);
    return eventually(() => near(code(), then));
  },
  "a path plays": async () => {
    await tab("path");
    await page.click("#add-keyframe");
    await page.click("#random");
    await eventually(rests);
    await page.click("#add-keyframe");
    const before = await picture();
    await page.click("#play");
    return eventually(async () => before !== (await picture()));
  },
  "the path comes to its end": () =>
    eventually(async () => (await page.$eval("#time", (time) => time.textContent)) === "t = 1.00"),
  "a shape is kept by name, compared, and there after a reload": async () => {
    await tab("shape");
    await page.click("#keep-shape");
    await page.keyboard.type("Mine");
    await page.keyboard.press("Tab");
    await page.click("[aria-label='Compare with Mine']");
    await eventually(() => page.$eval("#blend", (slider) => !slider.hidden));
    await page.reload();
    await eventually(rests);
    return page.$eval("#shelf input", (box) => box.value === "Mine");
  },
  "nothing complained": async () => !complaints.length,
};

let good = true;
for (const [name, step] of Object.entries(STEPS)) {
  const found = await step().catch((error) => {
    console.log(error.message);
    return false;
  });
  console.log(`${found ? "good" : "WRONG"}: ${name}`);
  good &&= Boolean(found);
}
for (const complaint of complaints) console.log(complaint);
await browser.close();
process.exit(good ? 0 : 1);

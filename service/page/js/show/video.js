/** Pictures, videos and GIFs of the stage, as shown. */

/**
 * Types of each format, the best first. Phones and slides play MP4 with H.264.
 * @type {Record<string, string[]>}
 */
const TYPES = {
  mp4: ["video/mp4;codecs=avc1.640033", "video/mp4;codecs=avc1.42E01F", "video/mp4"],
  webm: ["video/webm;codecs=vp9", "video/webm;codecs=vp8", "video/webm"],
};
const FPS = 30;
const BITS = 8e6; // per second
const REST = 200; // ms at the end, because the last pictures come late
const PATIENCE = 10_000; // ms to wait for the first picture
const GIFENC = new URL("../../vendor/gifenc/", import.meta.url).href;

/** Return a picture of the stage as PNG. */
export function picture(viewer) {
  return viewer.opaquely(() => {
    viewer.render();
    return new Promise((resolve) => {
      viewer.canvas.toBlob(resolve, "image/png");
    });
  });
}

/** Return the type that the browser records in a format, or undefined. */
const typeOf = (format) =>
  globalThis.MediaRecorder && TYPES[format]?.find((type) => MediaRecorder.isTypeSupported(type));

const GIF = "gif"; // plays everywhere, in chats and slides too, and every browser can make it

/** Return the formats of moving pictures that the browser makes. */
export const videoFormats = () => [...Object.keys(TYPES).filter(typeOf), GIF];

/**
 * Record a video of the stage, and call `show` with shares (0 … 1) of its time, until it returns false.
 * @returns {Promise<{blob: Blob, extension: string}>}
 */
export function record(viewer, seconds, show, format) {
  if (format === GIF) return gif(viewer, seconds, show);
  const type = typeOf(format);
  if (!type) throw new Error("This browser can't record videos. Keep the animation as a file instead.");
  return viewer.opaquely(async () => {
    const stream = viewer.canvas.captureStream(FPS);
    const recorder = new MediaRecorder(stream, { mimeType: type, videoBitsPerSecond: BITS });
    const parts = [];
    const first = new Promise((resolve, reject) => {
      recorder.addEventListener("dataavailable", ({ data }) => {
        parts.push(data);
        if (data.size) resolve();
      });
      recorder.addEventListener("error", ({ error }) => reject(error));
      setTimeout(() => reject(new Error("This browser records no pictures of the shape.")), PATIENCE);
    });
    const stopped = new Promise((resolve) => {
      recorder.addEventListener("stop", resolve);
    });
    recorder.start(1); // shortest parts, because the first one shows that there is a picture
    try {
      // On a busy machine, the recorder may need longer to start than the video lasts.
      await drawnUntil(viewer, first);
      await through(seconds, show);
      await new Promise((resolve) => {
        setTimeout(resolve, REST);
      });
    } finally {
      recorder.stop();
      await stopped;
      for (const track of stream.getTracks()) track.stop();
    }
    return { blob: new Blob(parts, { type }), extension: format };
  });
}

const MOST_PIXELS = 480; // of a GIF's longer side
const GIF_FRAME = 70; // ms

/** Make a GIF of the stage: as `record`, but each picture takes the time that it needs. */
function gif(viewer, seconds, show) {
  return viewer.opaquely(async () => {
    const { GIFEncoder, applyPalette, quantize } = await import(`${GIFENC}gifenc.esm.js`);
    const { canvas } = viewer;
    const scale = Math.min(MOST_PIXELS / Math.max(canvas.width, canvas.height), 1);
    const [width, height] = [canvas.width, canvas.height].map((size) => Math.round(scale * size));
    const small = Object.assign(document.createElement("canvas"), { width, height });
    const pen = small.getContext("2d", { willReadFrequently: true });
    const encoder = GIFEncoder();
    const steps = Math.max(Math.round((1000 * seconds) / GIF_FRAME), 1);
    for (let k = 0; k <= steps; k += 1) {
      if (show(k / steps) === false) break;
      viewer.render(); // in this task, since its picture is lost afterwards
      pen.drawImage(canvas, 0, 0, width, height);
      const { data } = pen.getImageData(0, 0, width, height);
      const palette = quantize(data, 256);
      encoder.writeFrame(applyPalette(data, palette), width, height, { palette, delay: GIF_FRAME });
      await new Promise(requestAnimationFrame); // so that the page answers meanwhile
    }
    encoder.finish();
    return { blob: new Blob([encoder.bytes()], { type: "image/gif" }), extension: GIF };
  });
}

/** Turn the view once around the shape. */
export async function turntable(viewer, seconds, format) {
  const { reference, view } = viewer;
  const same = () => viewer.reference === reference; // another model has its own view
  const show = (share) => same() && viewer.turn(view, 2 * Math.PI * share);
  try {
    return await record(viewer, seconds, show, format);
  } finally {
    if (same()) viewer.view = view;
  }
}

/** Draw for every picture of the screen until a promise resolves: only drawn pictures are recorded. */
async function drawnUntil(viewer, promise) {
  let waiting = true;
  const step = () => {
    if (!waiting) return;
    viewer.render();
    requestAnimationFrame(step);
  };
  step();
  try {
    await promise;
  } finally {
    waiting = false;
  }
}

function through(seconds, show) {
  return new Promise((resolve, reject) => {
    const began = performance.now();
    const step = (now) => {
      const share = Math.min(Math.max(now - began, 0) / (1000 * seconds), 1);
      try {
        const more = show(share) !== false && share < 1;
        if (more) requestAnimationFrame(step);
        else resolve();
      } catch (error) {
        reject(error);
      }
    };
    requestAnimationFrame(step);
  });
}

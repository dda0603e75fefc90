/** Pictures and videos of the stage, as it is seen. */

const TYPES = ["video/webm;codecs=vp9", "video/webm;codecs=vp8", "video/webm", "video/mp4"];
const FPS = 30;
const BITS = 8e6; // a second
const REST = 200; // ms at the end, as the last pictures come late
const PATIENCE = 10_000; // ms until the first picture must have come

/** The stage as PNG. */
export function picture(viewer) {
  return viewer.opaquely(() => {
    viewer.render();
    return new Promise((resolve) => {
      viewer.canvas.toBlob(resolve, "image/png");
    });
  });
}

/**
 * A video of the stage, while `show` is called with shares (0 … 1) of its time; where that answers false it
 * ends.
 * @returns {Promise<{blob: Blob, extension: string}>}
 */
export function record(viewer, seconds, show) {
  const type = globalThis.MediaRecorder && TYPES.find((each) => MediaRecorder.isTypeSupported(each));
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
    recorder.start(1); // parts as short as can be: the first tells that there is a picture
    try {
      // On a busy machine the recorder can take longer to begin than the whole video lasts.
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
    return { blob: new Blob(parts, { type }), extension: type.includes("mp4") ? "mp4" : "webm" };
  });
}

/** Once around the shape, back to where one looked from. */
export async function turntable(viewer, seconds) {
  const { view } = viewer;
  try {
    return await record(viewer, seconds, (share) => viewer.turn(view, 2 * Math.PI * share));
  } finally {
    viewer.view = view;
  }
}

/** Draw anew for every picture of the screen, as only what is drawn is recorded, until a promise is kept. */
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

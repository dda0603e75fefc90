/**
 * Computes shapes with a model's `decoder.onnx`, in a thread of its own.
 *
 * The first message has the addresses. Each further message is a code, whose answer is its shape.
 */

let session = null;

/** Return the content of a file, unpacked if it is a gzip file. Some servers unpack such files themselves. */
async function content(address, headers) {
  const response = await fetch(address, { headers });
  if (!response.ok) throw new Error(`The file ${new URL(address).pathname} did not arrive.`);
  const bytes = new Uint8Array(await response.arrayBuffer());
  if (bytes[0] !== 0x1f || bytes[1] !== 0x8b) return bytes;
  const unpacked = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(unpacked).arrayBuffer());
}

async function open({ runtime, decoder, headers }) {
  const [ort, graph, binary] = await Promise.all([
    import(`${runtime}ort.wasm.min.mjs`),
    content(decoder, headers),
    content(`${runtime}ort-wasm-simd-threaded.wasm.gz`),
  ]);
  // More threads need headers that few servers of files send.
  Object.assign(ort.env.wasm, { numThreads: 1, wasmBinary: binary });
  ort.env.logLevel = "error";
  // Otherwise the runtime would unpack the 8 and 16 bits of the matrices for every shape.
  const extra = { session: { disable_quant_qdq: "1" } };
  const opened = await ort.InferenceSession.create(graph, { executionProviders: ["wasm"], extra });
  return async (code) => {
    const latent = new ort.Tensor("float32", Float32Array.from(code), [1, code.length]);
    const { vertices, misfit } = await opened.run({ latent });
    return { positions: vertices.data, misfit: misfit.data[0] };
  };
}

addEventListener("message", async ({ data }) => {
  try {
    if (data.decoder) {
      session = open(data);
      await session;
      postMessage({});
    } else {
      const run = await session;
      const shape = await run(data.code);
      postMessage(shape, { transfer: [shape.positions.buffer] });
    }
  } catch (error) {
    postMessage({ failed: error.message });
  }
});

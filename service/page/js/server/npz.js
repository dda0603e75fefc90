/** Reads NPZ files, which are ZIP archives of NumPy arrays, by means of the browser alone. */

const READERS = {
  "<f4": (buffer) => new Float32Array(buffer),
  "<f8": (buffer) => new Float64Array(buffer),
  "<i4": (buffer) => new Int32Array(buffer),
  "<i8": (buffer) => Int32Array.from(new BigInt64Array(buffer), Number),
};

/** Return the arrays `names` of an archive as `{name: {shape, data}}`, without missing ones. */
export async function readNpz(buffer, names) {
  const entries = directory(new DataView(buffer)).filter(({ name }) => names.includes(name));
  const arrays = entries.map(async (entry) => [entry.name, readNpy(await content(buffer, entry))]);
  return Object.fromEntries(await Promise.all(arrays));
}

/** Return name, offset, size and compression of each file, from the directory at the end of the archive. */
function directory(view) {
  let end = view.byteLength - 22;
  while (end >= 0 && view.getUint32(end, true) !== 0x06054b50) end -= 1;
  if (end < 0) throw new Error("The server's answer is not an NPZ file, or only a part of one. Try again.");
  const entries = [];
  let at = view.getUint32(end + 16, true);
  for (let left = view.getUint16(end + 10, true); left > 0; left -= 1) {
    const lengths = [28, 30, 32].map((offset) => view.getUint16(at + offset, true));
    const name = new TextDecoder().decode(new Uint8Array(view.buffer, at + 46, lengths[0]));
    const header = view.getUint32(at + 42, true);
    const start = header + 30 + view.getUint16(header + 26, true) + view.getUint16(header + 28, true);
    entries.push({
      name: name.replace(/\.npy$/, ""),
      start,
      size: view.getUint32(at + 20, true),
      deflated: view.getUint16(at + 10, true) === 8,
    });
    at += 46 + lengths[0] + lengths[1] + lengths[2];
  }
  return entries;
}

function content(buffer, { start, size, deflated }) {
  const bytes = buffer.slice(start, start + size);
  if (!deflated) return bytes;
  return new Response(
    new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate-raw")),
  ).arrayBuffer();
}

function readNpy(buffer) {
  const view = new DataView(buffer);
  const wide = view.getUint8(6) > 1;
  const start = (wide ? 12 : 10) + (wide ? view.getUint32(8, true) : view.getUint16(8, true));
  const header = new TextDecoder("latin1").decode(new Uint8Array(buffer, 10, start - 10));
  const type = /'descr': '([^']+)'/.exec(header)[1];
  const shape = /'shape': \(([^)]*)\)/
    .exec(header)[1]
    .split(",")
    .filter((part) => part.trim())
    .map(Number);
  if (!READERS[type]) throw new Error(`An array of type ${type} is none that this page reads.`);
  return { shape, data: READERS[type](buffer.slice(start)) };
}

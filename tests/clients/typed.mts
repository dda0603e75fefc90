/**
 * A mesh, an animation and the code of a mesh, by a client with the types that openapi-typescript makes.
 *
 * node typed.mjs ADDRESS writes the sizes of the answers, and the code, as JSON.
 */

import createClient from "openapi-fetch";
import type { paths } from "./schema.js";

declare const process: { argv: string[] };

const client = createClient<paths>({ baseUrl: process.argv[2] });
const path = { name: "small" };
const code = [0.1, 0.2, 0.3];

function found<T>({ data, error }: { data?: T; error?: unknown }): T {
  if (data === undefined) throw new Error(JSON.stringify(error));
  return data;
}

const models = found(await client.GET("/v1/models"));
const [byAddress, byBody] = [
  await client.GET("/v1/models/{name}/mesh", { params: { path, query: { latent: code } }, parseAs: "blob" }),
  await client.POST("/v1/models/{name}/mesh", { params: { path }, body: { latent: code }, parseAs: "blob" }),
].map((answer) => found(answer) as Blob);
const made = found(
  await client.POST("/v1/models/{name}/interpolations", {
    params: { path },
    body: { keyframes: [code, [0.4, 0.1, 0.0]], frames: 3 },
  }),
);
const animation = found(
  await client.GET("/v1/interpolations/{id}", { params: { path: { id: made.id } }, parseAs: "blob" }),
) as Blob;
const form = new FormData();
form.append("file", byBody, "shape.glb");
const encoded = found(
  await client.POST("/v1/models/{name}/encode", {
    params: { path },
    body: { file: "" },
    bodySerializer: () => form,
  }),
);
console.log(
  JSON.stringify({
    models: models.models.map(({ name }) => name),
    meshes: [byAddress.size, byBody.size],
    animation: animation.size,
    latent: encoded.latent,
  }),
);

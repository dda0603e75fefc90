// The Khronos glTF validator as a command: `node validate_gltf.mjs FILE...`, or one asset on stdin.
// Prints one JSON report a line; exits 1 where a report has errors.

import { readFileSync } from "node:fs";
import { dirname, resolve } from "node:path";
import validator from "gltf-validator";

const STDIN = "-";
let failed = false;

for (const path of process.argv.length > 2 ? process.argv.slice(2) : [STDIN]) {
  const report = await validator.validateBytes(new Uint8Array(readFileSync(path === STDIN ? 0 : path)), {
    uri: path,
    maxIssues: 100, // a morph animation can repeat one fault thousands of times
    writeTimestamp: false,
    externalResourceFunction: async (uri) =>
      new Uint8Array(readFileSync(resolve(dirname(path), decodeURIComponent(uri)))),
  });
  console.log(JSON.stringify(report));
  failed ||= report.issues.numErrors > 0;
}

process.exitCode = failed ? 1 : 0;

/** One call of the server as text to copy: for the shell, for programs, and for other pages. */

const json = (body) => JSON.stringify(body);

/**
 * @typedef {object} Call
 * @property {string} url
 * @property {object} body numbers and strings, which Python and JSON write alike
 * @property {string} file name for the answer
 * @property {string} embed address of the viewer alone
 * @property {string} title of the model
 */

/** The text that needs no call. */
export const FRAME = "a frame in a page";

/** Writers of the texts, by their names in the page. @type {Record<string, (call: Call) => string>} */
export const CODE = {
  curl: ({ url, body, file }) =>
    `curl '${url}' -H 'content-type: application/json' -d '${json(body)}' -o ${file}`,

  Python: ({ url, body, file }) => `import json
from urllib.request import Request, urlopen

body = ${json(body)}
request = Request("${url}", json.dumps(body).encode(), {"Content-Type": "application/json"})
with urlopen(request) as answer, open("${file}", "wb") as file:
    file.write(answer.read())
`,

  JavaScript: ({ url, body }) => `const answer = await fetch("${url}", {
  method: "POST",
  headers: { "Content-Type": "application/json" },
  body: JSON.stringify(${json(body)}),
});
if (!answer.ok) throw new Error(await answer.text());
const file = await answer.arrayBuffer();
`,

  [FRAME]: ({ embed, title }) => {
    const plain = (text) => text.replace(/[&<>"]/g, (sign) => `&#${sign.charCodeAt(0)};`);
    const look = 'width="480" height="480" style="border:0"';
    return `<iframe src="${plain(embed)}" title="${plain(title)}" ${look}></iframe>`;
  },
};

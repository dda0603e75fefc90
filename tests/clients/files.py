"""The files that other programs open, and the positions that they must find in them."""

import io
import json
from pathlib import Path

import httpx
import numpy as np

#: Frames of the animation with a morph target for each, and of the one with a basis of fewer targets.
SHORT, LONG = 12, 70


def write_files(client: httpx.Client, model: str, folder: Path) -> None:
    """Ask a server for a shape and two animations of a model, and write them with ``expected.json``.

    ``expected.json`` has the shape's positions, and those of each animation at four times, in frames: at
    both ends, in the middle, and half-way between two frames, where players interpolate linearly.
    """
    card = client.get(f"/v1/models/{model}").raise_for_status().json()
    low, high = np.array(card["lower"]), np.array(card["upper"])
    codes = [(low + share * (high - low)).tolist() for share in (0.5, 0.6)]

    def save(name: str, link: str, **params: str) -> bytes:
        content = client.get(link, params=params or None).raise_for_status().content
        (folder / name).write_bytes(content)
        return content

    expected = {}
    for name, count in (("animation", SHORT), ("long", LONG)):
        created = client.post(f"/v1/models/{model}/interpolations", json={"keyframes": codes, "frames": count})
        links = created.raise_for_status().json()["links"]
        for format in ("glb", "pc2", "usd"):
            save(f"{name}.{format}", links[format])
        frames = np.load(io.BytesIO(save(f"{name}.npz", links["npz"])))["vertices"].astype(float)
        times = [0, count // 2, 1.5, count - 1]
        seen = [(frames[int(np.floor(t))] + frames[int(np.ceil(t))]) / 2 for t in times]
        expected[name] = {"times": times, "vertices": [vertices.tolist() for vertices in seen]}
        if name == "animation":
            last = links["frames"].format(k=count - 1)
            save("shape.glb", last)
            save("colored.glb", last, color="stretch")
            save("first.obj", links["frames"].format(k=0), format="obj")
            expected["shape"] = {"vertices": seen[-1].tolist()}
    # Short animations are exact; a basis is within 1e-4 of the diagonal at every vertex.
    diagonal = float(np.linalg.norm(np.ptp(seen[0], axis=0)))
    expected |= {"tolerance": 1e-5 * diagonal, "basis_tolerance": 1.1e-4 * diagonal}
    (folder / "expected.json").write_text(json.dumps(expected))

"""A client in one module, which needs httpx and NumPy and nothing else of this project.

>>> from shapespace.client import Client
>>> with Client("http://localhost:8000") as client:
...     glb = client.mesh("freaky-torus", [1, 2, 3, 4])
...     positions = client.vertices("freaky-torus", [[1, 2, 3, 4], [0, 0, 0, 0]])
"""

from __future__ import annotations

import io
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import httpx
import numpy as np
from numpy.typing import ArrayLike, NDArray

Options = str | int | float | bool | None
#: ``rotation`` (3, 3), ``translation`` (3,) and ``scale``, each of which may be left out.
Placement = Mapping[str, Any]


class ClientError(Exception):
    """A problem that the server answers with.

    Attributes:
        status: of the answer.
        type: stable name of the kind of problem.
        detail: what to do.
        request_id: by which the server's log names the request.
    """

    def __init__(self, answer: httpx.Response, problem: Mapping[str, Any] | None = None) -> None:
        try:
            problem = problem or answer.json()
        except ValueError:  # it comes from a proxy
            problem = {}
        self.status, self.type = problem.get("status", answer.status_code), problem.get("type", "about:blank")
        self.detail = problem.get("detail", answer.reason_phrase)
        self.request_id = answer.headers.get("X-Request-ID")
        super().__init__(f"{self.status}: {self.detail}")


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in the units of the training meshes.

    Attributes:
        vertices: (V, 3) float32.
        faces: (F, 3), from 0.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int64]


class Client:
    """Calls of a shapespace server, as functions.

    Every call raises ClientError where the server answers with a problem, and httpx.HTTPError where it doesn't answer.

    Args:
        url: of the server.
        api_key: for servers that want one.
        timeout: seconds to wait for each answer.
        retries: how often a busy server is asked again, each time after the wait that it names.
    """

    def __init__(self, url: str, *, api_key: str | None = None, timeout: float = 120, retries: int = 3) -> None:
        headers = {"Authorization": f"Bearer {api_key}"} if api_key else {}
        self._http = httpx.Client(base_url=url, headers=headers, timeout=timeout)
        self._retries = retries

    def __enter__(self) -> Client:
        return self

    def __exit__(self, _: type[BaseException] | None, __: BaseException | None, ___: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections."""
        self._http.close()

    def models(self) -> list[dict[str, Any]]:
        """The newest version of every model."""
        found: list[dict[str, Any]] = self._send("GET", "/v1/models").json()["models"]
        return found

    def model(self, name: str, version: str | None = None) -> dict[str, Any]:
        """A model's card."""
        card: dict[str, Any] = self._send("GET", f"/v1/models/{name}", params={"version": version}).json()
        return card

    def mesh(
        self,
        name: str,
        latent: ArrayLike | None = None,
        format: str = "glb",
        *,
        place: Placement | None = None,
        covariance: ArrayLike | None = None,
        **options: Options,
    ) -> bytes:
        """The file of one shape, or of the reference.

        Args:
            name: of the model.
            latent: (m,).
            format: glb, gltf, obj, ply, stl, npz, zip (OBJ with materials and textures) or json.
            place: where to answer it, as ``edit`` answers a ``placement``.
            covariance: (m, m) of codes around ``latent``, to colour the shape by how far its vertices may be.
            options: version, mesh ("fine" or "coarse"), bounds ("allow", "clamp" or "reject"), quality ("full" or
                "draft"), color, topology ("original" or "triangles").
        """
        path, params = f"/v1/models/{name}/mesh", {"format": format, "place": _json(place), **options}
        if covariance is not None:
            body = {"latent": _numbers([] if latent is None else latent), "covariance": _numbers(covariance)}
            if "bounds" in params:
                body["bounds"] = params.pop("bounds")
            return self._send("POST", path, params={"color": "spread"} | params, json=body).content
        code = None if latent is None else ",".join(map(repr, _numbers(latent)))
        return self._send("GET", path, params={"latent": code} | params).content

    def shape(
        self, name: str, latent: ArrayLike | None = None, *, place: Placement | None = None, **options: Options
    ) -> Mesh:
        """One shape, or the reference, as arrays; options as for ``mesh``."""
        arrays = _arrays(self.mesh(name, latent, "npz", place=place, **options))
        return Mesh(arrays["vertices"].astype(np.float32), arrays["faces"].astype(np.int64))

    def blend_shapes(self, name: str, **options: Options) -> bytes:
        """A GLB with a morph target for each end of each coordinate.

        Args:
            name: of a model without angles among its coordinates.
            options: version, mesh ("fine" or "coarse").
        """
        content: bytes = self._send("GET", f"/v1/models/{name}/blendshapes", params=options).content
        return content

    def vertices(
        self,
        name: str,
        latents: ArrayLike,
        *,
        version: str | None = None,
        place: Placement | None = None,
        **options: Options,
    ) -> NDArray[np.float32]:
        """Positions (n, V, 3) of codes (n, m).

        Args:
            name: of the model.
            latents: (n, m).
            version: of the model.
            place: where to answer them, see ``mesh``.
            options: mesh ("fine" or "coarse"), bounds ("allow", "clamp" or "reject"), quality ("full" or "draft").
        """
        answer = self._send(
            "POST",
            f"/v1/models/{name}/vertices",
            params={"version": version, "format": "npz", "place": _json(place)},
            json={"latents": _numbers(latents), "faces": False, **options},
        )
        return _arrays(answer.content)["vertices"].astype(np.float32)

    def nric(
        self, name: str, latents: ArrayLike, *, version: str | None = None, **options: Options
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Edge lengths and dihedral angles, (n, E) each, of codes (n, m); options: bounds."""
        answer = self._send(
            "POST",
            f"/v1/models/{name}/nric",
            params={"version": version},
            json={"latents": _numbers(latents), **options},
        ).json()
        return np.array(answer["lengths"]), np.array(answer["angles"])

    def interpolate(
        self, name: str, keyframes: ArrayLike, *, version: str | None = None, quality: str = "full", **options: Any
    ) -> Interpolation:
        """An animation along a path of codes.

        Args:
            name: of the model.
            keyframes: (k, m), at least two.
            version: of the model.
            quality: of the frames, "full" or "draft".
            options: frames, times, start, stop, loop, mesh.
        """
        answer = self._send(
            "POST",
            f"/v1/models/{name}/interpolations",
            params={"version": version},
            json={"keyframes": _numbers(keyframes), **options},
        ).json()
        return Interpolation(self, answer["id"], answer["frames"], quality)

    def encode(
        self,
        name: str,
        mesh: Mesh | bytes | Path,
        format: str | None = None,
        *,
        fixed: Mapping[int, float] | None = None,
        **options: Options,
    ) -> dict[str, Any]:
        """The code whose shape is closest to a mesh in correspondence, whatever its rotation and position.

        Args:
            name: of the model.
            mesh: arrays, a file or its content.
            format: of the content; by default the file's suffix.
            fixed: value by coordinate that the code keeps.
            options: version, bounds ("allow", "clamp" or "reject"), objective ("vertices" or "nric"); samples, how many
                codes to draw from the posterior; seed.

        Returns:
            ``latent``, ``residual``, ``vertex_error``, ``covariance``, ``samples`` and more.
        """
        content, format = _file(mesh, format)
        headers = {"Content-Type": "application/octet-stream"}
        params = {"format": format, "fixed": _json(_by_index(fixed)), **options}
        found: dict[str, Any] = self._send(
            "POST", f"/v1/models/{name}/encode", params=params, content=content, headers=headers
        ).json()
        return found

    def fit(
        self,
        name: str,
        scan: Mesh | ArrayLike | bytes | Path,
        format: str | None = None,
        *,
        version: str | None = None,
        **options: Any,
    ) -> dict[str, Any]:
        """The code, place and size that explain a scan, without correspondence.

        Args:
            name: of the model.
            scan: points (N, 3), a mesh, a file or its content.
            format: of the content; by default the file's suffix.
            version: of the model.
            options: scale ("fixed" or "free"), partial, noise, landmarks, fixed (value by coordinate), distribution
                ("population" or "box"), samples, points, used, seed.

        Returns:
            ``latent``, ``covariance``, ``placement``, ``status``, ``reason`` and more.
        """
        if isinstance(scan, bytes | Path | Mesh):
            content, format = _file(scan, format)
        else:
            buffer = io.BytesIO()
            np.savez(buffer, vertices=np.asarray(scan, dtype=np.float64))
            content, format = buffer.getvalue(), "npz"
        if "fixed" in options:
            options["fixed"] = _by_index(options["fixed"]) or {}
        found: dict[str, Any] = self._send(
            "POST",
            f"/v1/models/{name}/fit",
            params={"version": version, "format": format},
            files={"file": ("scan", content)},
            data={"options": _json(options)},
        ).json()
        return found

    def edit(
        self,
        name: str,
        latent: ArrayLike,
        targets: Mapping[int, Sequence[float] | Mapping[str, Any]],
        *,
        version: str | None = None,
        sigma: float | None = None,
        fixed: Mapping[int, float] | None = None,
        **options: Options,
    ) -> dict[str, Any]:
        """The code inside the hypercube whose shape comes closest to having some vertices at some places.

        Args:
            name: of the model.
            latent: (m,) to start from.
            targets: position (3,) by vertex, in the frame in which the shape of ``latent`` is answered, or
                ``{"position", "sigma"}``.
            version: of the model.
            sigma: standard deviation of the targets that have none.
            fixed: value by coordinate that the code keeps.
            options: prior, the weight that holds the code back; prior_kind, "groups" or "ridge"; anchored, whether the
                whole stays in its place; mesh, the one whose vertices are meant; samples, how many codes to draw from
                the posterior; seed.

        Returns:
            ``latent``, ``placement``, ``residual``, ``covariance``, ``samples`` and more.
        """
        places = []
        for vertex, target in targets.items():
            given = target if isinstance(target, Mapping) else {"position": _numbers(target)}
            places.append({"vertex": int(vertex)} | ({} if sigma is None else {"sigma": sigma}) | dict(given))
        held = {} if fixed is None else {"fixed": _by_index(fixed)}
        found: dict[str, Any] = self._send(
            "POST",
            f"/v1/models/{name}/edit",
            params={"version": version},
            json={"latent": _numbers(latent), "targets": places, **held, **options},
        ).json()
        return found

    def sample(self, name: str, count: int, *, version: str | None = None, **options: Options) -> NDArray[np.float64]:
        """Random codes (count, m).

        Args:
            name: of the model.
            count: how many.
            version: of the model.
            options: seed; distribution, "uniform" or "gaussian" inside the bounds, or "population", as the codes of the
                training shapes; temperature, the factor of the population's differences from its mean.
        """
        answer = self._send(
            "POST", f"/v1/models/{name}/sample", params={"version": version}, json={"count": count, **options}
        ).json()
        return np.array(answer["latents"])

    def _send(self, method: str, path: str, *, params: Mapping[str, Options] | None = None, **sent: Any) -> Any:
        given = {key: value for key, value in (params or {}).items() if value is not None}
        for attempt in range(self._retries + 1):
            answer = self._http.request(method, path, params=given, **sent)
            if answer.status_code != httpx.codes.SERVICE_UNAVAILABLE or attempt == self._retries:
                break
            wait = answer.headers.get("Retry-After", "")
            time.sleep(int(wait) if wait.isdecimal() else 1)  # a proxy may send a date
        if answer.is_error:
            raise ClientError(answer)
        return answer


@dataclass(frozen=True)
class Interpolation:
    """An animation; iterating over it gives each frame's vertices (V, 3) as soon as it is ready.

    Attributes:
        client: the one that asked for it.
        id: holds the whole request, so that any replica can answer it, at any time.
        frames: how many there are.
        quality: "full", or "draft": quicker, and nearly the same.
    """

    client: Client
    id: str
    frames: int
    quality: str = "full"

    def __iter__(self) -> Iterator[NDArray[np.float32]]:
        path, http = f"/v1/interpolations/{self.id}", self.client._http
        with http.stream("GET", path, params={"format": "jsonl", "quality": self.quality}) as answer:
            if answer.is_error:
                answer.read()
                raise ClientError(answer)
            for line in answer.iter_lines():
                frame = json.loads(line)
                if problem := frame.get("problem"):
                    raise ClientError(answer, problem)
                yield np.array(frame["vertices"], dtype=np.float32)

    def file(self, format: str = "glb", fps: float | None = None) -> bytes:
        """The whole animation; GLB, USD and USDZ with so many frames in a second."""
        return self._get("", format, fps=fps)

    def frame(self, k: int, format: str = "glb") -> bytes:
        """One frame, from 0."""
        return self._get(f"/frames/{k}", format)

    def vertices(self) -> NDArray[np.float32]:
        """Positions (frames, V, 3)."""
        return _arrays(self.file("npz"))["vertices"].astype(np.float32)

    def _get(self, path: str, format: str, **more: Options) -> bytes:
        params = {"format": format, "quality": self.quality, **more}
        content: bytes = self.client._send("GET", f"/v1/interpolations/{self.id}{path}", params=params).content
        return content


def _by_index(fixed: Mapping[int, float] | None) -> dict[str, float] | None:
    """As JSON has it, whose members have names."""
    return None if fixed is None else {str(int(index)): float(value) for index, value in fixed.items()}


def _json(value: Mapping[Any, Any] | None) -> str | None:
    """As it stands in an address."""
    return None if value is None else json.dumps(value, default=lambda array: array.tolist())


def _file(mesh: Mesh | bytes | Path, format: str | None) -> tuple[bytes, str | None]:
    """The content of a mesh file, and its format where that is known."""
    if isinstance(mesh, Mesh):
        buffer = io.BytesIO()
        np.savez(buffer, vertices=mesh.vertices, faces=mesh.faces)
        return buffer.getvalue(), "npz"
    if isinstance(mesh, Path):
        return mesh.read_bytes(), format or mesh.suffix.lstrip(".")
    return mesh, format


def _numbers(values: ArrayLike) -> Any:
    """Nested lists, as JSON takes them."""
    return np.asarray(values, dtype=np.float64).tolist()


def _arrays(content: bytes) -> dict[str, NDArray]:
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        return dict(arrays)

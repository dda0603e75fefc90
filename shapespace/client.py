"""Client of a shapespace server. It can be copied as one file, and needs only httpx and NumPy.

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
from typing import Any, TypedDict, Unpack

import httpx
import numpy as np
from numpy.typing import ArrayLike, NDArray

#: A query parameter, or a member of a JSON body.
Parameter = str | int | float | bool | None
#: ``rotation`` (3, 3), ``translation`` (3,) and ``scale``; each may be left out.
Placement = Mapping[str, Any]


class SearchParameters(TypedDict, total=False):
    """Parameters of every search for a code, as the server describes them."""

    version: str | None  # version of the model; by default the server's default version
    fixed: Mapping[int, float] | None  # values of coordinates that the code keeps, by index
    samples: int  # number of codes to draw from the posterior
    seed: int  # seed of the random numbers


class EncodeParameters(SearchParameters, total=False):
    """Parameters of ``encode``."""

    bounds: str  # "allow", "clamp" or "reject"
    objective: str  # "vertices" or "nric"


class EditParameters(SearchParameters, total=False):
    """Parameters of ``edit``."""

    prior: float  # weight of changes of the code
    prior_kind: str  # "groups" changes few factors, "ridge" all factors a little
    mesh: str  # mesh that the vertices belong to, "fine" or "coarse"
    sigma: float | None  # standard deviation of targets that have none
    anchored: bool  # whether only vertices without a target decide where the whole shape lies


class FitParameters(SearchParameters, total=False):
    """Parameters of ``fit``."""

    scale: str  # "fixed", or "free" if the fit estimates the scan's size
    partial: bool  # whether the scan shows only a part of the shape
    noise: float | None  # standard deviation of the scan's points
    landmarks: Sequence[Mapping[str, Any]]  # vertices with known positions: ``{"vertex", "position", "sigma"}`` each
    distribution: str  # "population" or "box"
    points: bool  # whether to return the distance of each point
    used: bool  # whether to return the points that represented the scan


class ClientError(Exception):
    """Error that the server answers with.

    Attributes:
        status: HTTP status.
        type: stable name of the kind of problem.
        detail: sentence that says what to do.
        request_id: name of the request in the server's log.
    """

    def __init__(self, answer: httpx.Response, problem: Mapping[str, Any] | None = None) -> None:
        try:
            problem = problem or answer.json()
        except ValueError:  # an answer of a proxy
            problem = {}
        self.status, self.type = problem.get("status", answer.status_code), problem.get("type", "about:blank")
        self.detail = problem.get("detail", answer.reason_phrase)
        self.request_id = answer.headers.get("X-Request-ID")
        super().__init__(f"{self.status}: {self.detail}")


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in the units of the training meshes.

    Attributes:
        vertices: (V, 3) positions, float32.
        faces: (F, 3) vertex indices, from 0.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int64]


class Client:
    """Calls of a shapespace server, as methods.

    Every method raises ClientError if the server answers with a problem, and httpx.HTTPError if it doesn't answer.

    Args:
        url: address of the server.
        api_key: key, if the server requires one.
        timeout: seconds to wait for each answer.
        retries: how often the client repeats a request to a busy server, after the wait that the server names.
    """

    def __init__(self, url: str, *, api_key: str | None = None, timeout: float = 120, retries: int = 3) -> None:
        headers = {"Authorization": f"Bearer {api_key}"} if api_key else {}
        self._http = httpx.Client(base_url=url, headers=headers, timeout=timeout)
        self._retries = retries

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections."""
        self._http.close()

    def models(self) -> list[dict[str, Any]]:
        """Return every model, in its default version."""
        return self._send("GET", "/v1/models").json()["models"]

    def model(self, name: str, version: str | None = None) -> dict[str, Any]:
        """Return a model's card."""
        return self._send("GET", f"/v1/models/{name}", params={"version": version}).json()

    def mesh(
        self,
        name: str,
        latent: ArrayLike | None = None,
        format: str = "glb",
        *,
        place: Placement | None = None,
        covariance: ArrayLike | None = None,
        **options: Parameter,
    ) -> bytes:
        """Return the file of one shape, or of the reference.

        Args:
            name: name of the model.
            latent: (m,) code; None for the reference.
            format: glb, gltf, obj, ply, stl, npz, zip (OBJ with materials and textures) or json.
            place: placement of the shape, for example the ``placement`` that ``edit`` returns.
            covariance: (m, m) covariance of codes around ``latent``, to colour vertices by their standard deviation.
            options: version, mesh ("fine" or "coarse"), bounds ("allow", "clamp" or "reject"), quality ("auto",
                "full" or "draft"), color, topology ("original" or "triangles").
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
        self, name: str, latent: ArrayLike | None = None, *, place: Placement | None = None, **options: Parameter
    ) -> Mesh:
        """Return one shape, or the reference, as arrays; options as for ``mesh``."""
        arrays = _arrays(self.mesh(name, latent, "npz", place=place, **options))
        return Mesh(arrays["vertices"].astype(np.float32), arrays["faces"].astype(np.int64))

    def blend_shapes(self, name: str, **options: Parameter) -> bytes:
        """Return a GLB with a morph target for each end of each coordinate.

        Args:
            name: name of a model without angles among its coordinates.
            options: version, mesh ("fine" or "coarse").
        """
        return self._send("GET", f"/v1/models/{name}/blendshapes", params=options).content

    def vertices(
        self,
        name: str,
        latents: ArrayLike,
        *,
        version: str | None = None,
        place: Placement | None = None,
        **options: Parameter,
    ) -> NDArray[np.float32]:
        """Return positions (n, V, 3) of codes (n, m).

        Args:
            name: name of the model.
            latents: (n, m) codes.
            version: version of the model; by default the server's default version.
            place: placement of the shapes, see ``mesh``.
            options: mesh ("fine" or "coarse"), bounds ("allow", "clamp" or "reject"), quality ("auto", "full" or
                "draft").
        """
        params = {"version": version, "format": "npz", "place": _json(place)}
        body = {"latents": _numbers(latents), "faces": False, **options}
        answer = self._send("POST", f"/v1/models/{name}/vertices", params=params, json=body)
        return _arrays(answer.content)["vertices"].astype(np.float32)

    def nric(
        self, name: str, latents: ArrayLike, *, version: str | None = None, **options: Parameter
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return edge lengths and dihedral angles, (n, E) each, of codes (n, m); options: bounds."""
        answer = self._post(name, "nric", {"version": version}, json={"latents": _numbers(latents), **options})
        return np.array(answer["lengths"]), np.array(answer["angles"])

    def interpolate(
        self, name: str, keyframes: ArrayLike, *, version: str | None = None, quality: str = "auto", **options: Any
    ) -> Interpolation:
        """Make an animation along a path of codes.

        Args:
            name: name of the model.
            keyframes: (k, m) codes, at least two.
            version: version of the model; by default the server's default version.
            quality: quality of the frames, "auto", "full" or "draft".
            options: frames, times, start, stop, loop, mesh, name.
        """
        body = {"keyframes": _numbers(keyframes), **options}
        answer = self._post(name, "interpolations", {"version": version}, json=body)
        return Interpolation(self, answer["id"], answer["frames"], quality)

    def encode(
        self, name: str, mesh: Mesh | bytes | Path | str, format: str | None = None, **options: Unpack[EncodeParameters]
    ) -> dict[str, Any]:
        """Find the code whose shape comes closest to a mesh in correspondence, in any rigid pose.

        Args:
            name: name of the model.
            mesh: arrays, the path of a file, or its content.
            format: format of the content; by default the file's suffix.
            options: see EncodeParameters.

        Returns:
            ``latent``, ``status``, ``reason``, ``vertex_error``, ``covariance``, ``samples`` and more. The status is
            "poor" if the mesh has another vertex order, is mirrored, or has vertices far off: ``cause`` says which.
        """
        content, format = _file(mesh, format)
        headers = {"Content-Type": "application/octet-stream"}
        params: dict[str, Any] = {"format": format, **options, "fixed": _json(_by_index(options.get("fixed")))}
        return self._post(name, "encode", params, content=content, headers=headers)

    def fit(
        self,
        name: str,
        scan: Mesh | ArrayLike | bytes | Path | str,
        format: str | None = None,
        **options: Unpack[FitParameters],
    ) -> dict[str, Any]:
        """Find the code, placement and size that explain a scan without correspondence.

        Args:
            name: name of the model.
            scan: points (N, 3), a mesh, the path of a file, or its content.
            format: format of the content; by default the file's suffix.
            options: see FitParameters.

        Returns:
            ``latent``, ``covariance``, ``placement``, ``status``, ``reason`` and more.
        """
        if isinstance(scan, bytes | Path | str | Mesh):
            content, format = _file(scan, format)
        else:
            content, format = _npz(vertices=np.asarray(scan, dtype=np.float64)), "npz"
        sent: dict[str, Any] = {**options}
        version = sent.pop("version", None)
        if "fixed" in sent:
            sent["fixed"] = _by_index(sent["fixed"]) or {}
        params, form = {"version": version, "format": format}, {"options": _json(sent)}
        return self._post(name, "fit", params, files={"file": ("scan", content)}, data=form)

    def edit(
        self,
        name: str,
        latent: ArrayLike,
        targets: Mapping[int, Sequence[float] | Mapping[str, Any]],
        **options: Unpack[EditParameters],
    ) -> dict[str, Any]:
        """Find the code inside the bounds whose shape comes closest to having some vertices at given positions.

        Args:
            name: name of the model.
            latent: (m,) code to start from.
            targets: position (3,) or ``{"position", "sigma"}`` by vertex, in the frame of the shape of ``latent``.
            options: see EditParameters.

        Returns:
            ``latent``, ``placement``, ``residual``, ``covariance``, ``samples`` and more.
        """
        sent: dict[str, Any] = {**options}
        version, sigma, fixed = (sent.pop(name, None) for name in ("version", "sigma", "fixed"))
        places = []
        for vertex, target in targets.items():
            given = target if isinstance(target, Mapping) else {"position": _numbers(target)}
            places.append({"vertex": int(vertex)} | ({} if sigma is None else {"sigma": sigma}) | dict(given))
        held = {} if fixed is None else {"fixed": _by_index(fixed)}
        body = {"latent": _numbers(latent), "targets": places, **held, **sent}
        return self._post(name, "edit", {"version": version}, json=body)

    def sample(self, name: str, count: int, *, version: str | None = None, **options: Parameter) -> NDArray[np.float64]:
        """Return random codes (count, m).

        Args:
            name: name of the model.
            count: number of codes.
            version: version of the model; by default the server's default version.
            options: seed; distribution, "uniform" or "gaussian" inside the bounds, or "population", the Gaussian of the
                training codes; temperature, the factor of the population's differences from its mean.
        """
        answer = self._post(name, "sample", {"version": version}, json={"count": count, **options})
        return np.array(answer["latents"])

    def _post(self, name: str, call: str, params: Mapping[str, Parameter], **sent: Any) -> dict[str, Any]:
        return self._send("POST", f"/v1/models/{name}/{call}", params=params, **sent).json()

    def _send(
        self, method: str, path: str, *, params: Mapping[str, Parameter] | None = None, **sent: Any
    ) -> httpx.Response:
        given = {key: value for key, value in (params or {}).items() if value is not None}
        for attempt in range(self._retries + 1):
            answer = self._http.request(method, path, params=given, **sent)
            if answer.status_code != httpx.codes.SERVICE_UNAVAILABLE or attempt == self._retries:
                break
            wait = answer.headers.get("Retry-After", "")
            time.sleep(int(wait) if wait.isdecimal() else 1)  # a proxy may send a date instead
        if answer.is_error:
            raise ClientError(answer)
        return answer


@dataclass(frozen=True)
class Interpolation:
    """An animation. Iterating over it yields the vertices (V, 3) of each frame as soon as the frame is ready.

    Attributes:
        client: client that asked for the animation.
        id: the whole request, so that any replica can answer it at any time.
        frames: number of frames.
        quality: "auto"; "full", the converged solution; or "draft", the quickest.
    """

    client: Client
    id: str
    frames: int
    quality: str = "auto"

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
        """Return the whole animation; ``fps`` is the number of frames per second in GLB, USD and USDZ."""
        return self._get("", format, fps=fps)

    def frame(self, k: int, format: str = "glb") -> bytes:
        """Return frame k, counted from 0."""
        return self._get(f"/frames/{k}", format)

    def vertices(self) -> NDArray[np.float32]:
        """Return positions (frames, V, 3)."""
        return _arrays(self.file("npz"))["vertices"].astype(np.float32)

    def _get(self, path: str, format: str, **more: Parameter) -> bytes:
        params = {"format": format, "quality": self.quality, **more}
        return self.client._send("GET", f"/v1/interpolations/{self.id}{path}", params=params).content


def _by_index(fixed: Mapping[int, float] | None) -> dict[str, float] | None:
    """Return values by index as JSON has them: its members have strings as names."""
    return None if fixed is None else {str(int(index)): float(value) for index, value in fixed.items()}


def _json(value: Mapping[Any, Any] | None) -> str | None:
    """Return a value as JSON text for a query."""
    return None if value is None else json.dumps(value, default=lambda array: array.tolist())


def _file(mesh: Mesh | bytes | Path | str, format: str | None) -> tuple[bytes, str | None]:
    """Return the content of a mesh file, and its format if that is known."""
    if isinstance(mesh, Mesh):
        return _npz(vertices=mesh.vertices, faces=mesh.faces), "npz"
    if isinstance(mesh, str | Path):
        return Path(mesh).read_bytes(), format or Path(mesh).suffix.lstrip(".")
    return mesh, format


def _numbers(values: ArrayLike) -> Any:
    """Return nested lists, as JSON takes them."""
    return np.asarray(values, dtype=np.float64).tolist()


def _npz(**arrays: Any) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def _arrays(content: bytes) -> dict[str, NDArray]:
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        return dict(arrays)

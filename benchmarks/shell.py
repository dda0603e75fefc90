"""Times of exponentials, geodesics and reconstructions on capsules of several sizes: ``python -m benchmarks.shell``.

The capsules have radius 1 and length 2, are closed, of genus 0, and are bent by 75° in all; η = 4e-4 at unit area; one
thread. Each time stands next to a multiple of one SuperLU factorisation (symmetric mode) of ``JᵀJ`` of the same mesh,
timed in turn with it, because machines and their load differ. Residuals are measured afterwards, with a new factor for
every step. Symbolic analysis is done once a collection; it has its own column.
"""

import argparse
import time
from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.spatial import ConvexHull
from threadpoolctl import threadpool_limits

from benchmarks.bundles import superlu
from shapespace.coordinates.nric import nric, unwrap
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.energy import Material
from shapespace.shell.exponential import exponential
from shapespace.shell.geodesic import geodesic
from shapespace.shell.space import DiscretePath, ShellSpace
from shapespace.solve.preconditioner import step_length
from tests.shapespace.conftest import bent

MATERIAL = Material(eta=4e-4)


def even_capsule(count: int, radius: float = 1.0, length: float = 2.0) -> TriangleMesh:
    """Return a capsule with exactly ``count`` evenly spread vertices, axis along x. `synthetic` makes uneven capsules.

    Points at the golden angle and equal steps along the axis have equal area (Archimedes). A conformal map takes the
    capsule to the sphere, where the convex hull is the Delaunay triangulation.
    """
    end = length / 2
    x = ((np.arange(count) + 0.5) / count - 0.5) * (length + 2 * radius)
    phi = np.arange(count) * np.pi * (3 - np.sqrt(5))
    beyond = np.maximum(np.abs(x) - end, 0) / radius
    rho = radius * np.sqrt(1 - beyond**2)
    s = np.sign(x) * (np.minimum(np.abs(x), end) / radius + np.arctanh(beyond))
    sphere = np.stack([np.tanh(s), np.cos(phi) / np.cosh(s), np.sin(phi) / np.cosh(s)], axis=1)
    faces = ConvexHull(sphere).simplices
    a, b, c = (sphere[faces[:, k]] for k in range(3))
    inward = np.einsum("fc,fc->f", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward, ::-1]
    return TriangleMesh.from_arrays(np.stack([x, rho * np.cos(phi), rho * np.sin(phi)], axis=1), faces)


def timed(task: Callable[[], object], yardstick: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Return medians of the task's processor seconds, and of their ratio to the yardstick's."""
    task()
    measured = [(clock(yardstick), clock(task)) for _ in range(repeats)]
    return float(np.median([own for _, own in measured])), float(np.median([own / other for other, own in measured]))


def clock(task: Callable[[], object]) -> float:
    """Return processor seconds, which another process on the machine disturbs little."""
    began = time.process_time()
    task()
    return time.process_time() - began


def largest_residual(space: ShellSpace, path: DiscretePath) -> float:
    """Return the largest ``sqrt(F_kᵀ A_k⁻¹ F_k)``, with A_k of each shape itself."""
    points = [space.point(x) for x in path.vertices]
    worst, triples = 0.0, zip(points, points[1:], points[2:], strict=False)
    for before, here, after in triples:
        forces = here.pull_back(before.rest.gradient_deformed(here.z) + here.rest.gradient_rest(after.z))
        worst = max(worst, step_length(forces, space.factorise(here).solve(forces)))
    return worst


class Case:
    """A capsule, its bend, and the yardstick."""

    def __init__(self, count: int) -> None:
        self.mesh = even_capsule(count)
        self.end = bent(self.mesh.vertices, np.radians(75))
        t = time.perf_counter()
        self.space = ShellSpace(self.mesh, MATERIAL)
        z = self.space.nric(self.mesh.vertices)
        self.velocity = self.space.project(self.mesh.vertices, unwrap(self.space.nric(self.end), z) - z)
        self.analysis = time.perf_counter() - t
        jacobian = self.space.jacobian(self.mesh.vertices)
        #: One factorisation of JᵀJ.
        self.superlu = superlu(jacobian.T @ jacobian)

    def shoot(self, steps: int) -> DiscretePath:
        """Return the exponential."""
        return exponential(self.space, self.mesh.vertices, self.velocity, steps)

    def connect(self, steps: int) -> DiscretePath:
        """Return the geodesic."""
        return geodesic(self.space, self.mesh.vertices, self.end, steps)

    def report(self, name: str, find: Callable[[], DiscretePath], repeats: int) -> None:
        """Print a row."""
        path = find()
        if not path.converged:
            raise ArithmeticError(f"{name}, V = {len(self.mesh.vertices)}: {path.reason}")
        residual = largest_residual(self.space, path)
        print(row(name, self, find, repeats), f"{path.iterations} ({residual:.1e}) |", flush=True)


def row(name: str, case: Case, task: Callable[[], object], repeats: int) -> str:
    """Return the timed columns of a row."""
    cpu, ratio = timed(task, case.superlu, repeats)
    return f"| {name} | {len(case.mesh.vertices)} | {cpu:.3f} | {ratio:.2f} |"


def main() -> None:
    """Print the tables of docs/measurements/performance.md."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[500, 1000, 2000])
    parser.add_argument("--growth", type=int, nargs="*", default=[500, 1000, 2000, 5000, 10000])
    parser.add_argument("--repeats", type=int, default=7)
    options = parser.parse_args()
    with threadpool_limits(1):
        ShellSpace(even_capsule(100)).factorisations(1)  # load the solver's library
        print("| | V | seconds | × SuperLU | iterations (residual) |")
        print("|---|---|---|---|---|")
        cases = [Case(count) for count in options.sizes]
        for case in cases:
            case.report("exponential, K = 16", partial(case.shoot, 16), options.repeats)
        for case in cases:
            case.report("geodesic, K = 8", partial(case.connect, 8), options.repeats)
        middle = cases[len(cases) // 2]
        middle.report("geodesic, K = 16", partial(middle.connect, 16), options.repeats)
        for steps in (8, 32, 64):
            middle.report(f"exponential, K = {steps}", partial(middle.shoot, steps), options.repeats)
        for case in cases:
            reconstruct = Reconstructor(case.mesh)
            target = nric(case.end, case.mesh.connectivity)
            task = partial(reconstruct, target)
            print(row("Gauss–Newton from the reference", case, task, options.repeats), end=" ")
            found = task()
            print(f"{found.iterations} ({found.residual:.1e}) |", flush=True)
        if len(options.growth) > 1:
            print("\n| V | analysis | exponential, K = 16 | geodesic, K = 8 |\n|---|---|---|---|")
            rows = []
            for count in options.growth:
                case, repeats = Case(count), 3
                shoot, connect = (
                    float(np.median([clock(task) for _ in range(repeats)]))
                    for task in (partial(case.shoot, 16), partial(case.connect, 8))
                )
                rows.append((count, shoot, connect))
                print(f"| {count} | {case.analysis:.3f} | {shoot:.3f} | {connect:.3f} |", flush=True)
            sizes, *times = np.log(np.array(rows)).T
            exponents = [np.polyfit(sizes, t, 1)[0] for t in times]
            print(
                f"\nProcessor seconds grow like V^{exponents[0]:.2f} (exponential) and V^{exponents[1]:.2f} (geodesic)."
            )


if __name__ == "__main__":
    main()

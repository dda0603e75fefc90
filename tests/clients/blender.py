"""Compare vertices in Blender with the expected ones: ``python blender.py FOLDER``, filled by files.py.

Runs in an environment of its own, with the package ``bpy``. Prints a line for each file; exits 1 where a vertex is not
where it should be.
"""

import json
import math
import sys
from pathlib import Path

import bpy
import numpy as np

FRAMES_PER_SECOND = 30
folder = Path(sys.argv[1])
expected = json.loads((folder / "expected.json").read_text())


def empty_scene() -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = FRAMES_PER_SECOND


def the_mesh() -> bpy.types.Object:
    (found,) = [item for item in bpy.context.scene.objects if item.type == "MESH"]
    return found


def seen(time: float, *, y_up: bool) -> np.ndarray:
    """(V, 3) positions at a time in frames, after all modifiers, in the coordinates of the file."""
    bpy.context.scene.frame_set(math.floor(time), subframe=time % 1)
    evaluated = the_mesh().evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = evaluated.to_mesh()
    flat = np.empty(3 * len(mesh.vertices))
    mesh.vertices.foreach_get("co", flat)
    world = np.array(evaluated.matrix_world)
    x, y, z = world[:3, :3] @ flat.reshape(-1, 3).T + world[:3, 3:]
    # Blender rotates files with y up, so that z is up.
    return np.stack([x, z, -y] if y_up else [x, y, z], axis=1)


def report(name: str, positions: list[np.ndarray], wanted: list[list], tolerance: float) -> bool:
    """Print the largest error and return whether it is within the tolerance."""
    pairs = list(zip(positions, map(np.array, wanted), strict=True))
    same = all(a.shape == b.shape for a, b in pairs)
    error = max(np.linalg.norm(a - b, axis=1).max() for a, b in pairs) if same else math.inf
    good = error <= tolerance
    sys.stderr.write(f"Blender   {name}: largest distance of a vertex {error:.1e}{'' if good else ': WRONG'}\n")
    return bool(good)


def animation(name: str, *, y_up: bool, tolerance: float) -> bool:
    stem = expected[Path(name).stem]
    return report(name, [seen(time, y_up=y_up) for time in stem["times"]], stem["vertices"], tolerance)


def main() -> bool:
    exact, results = expected["tolerance"], []
    for name in ("shape.glb", "colored.glb"):
        empty_scene()
        bpy.ops.import_scene.gltf(filepath=str(folder / name))
        coloured = len(the_mesh().data.color_attributes) == (name == "colored.glb")
        positions = seen(0, y_up=True) if coloured else np.empty((0, 3))
        results.append(report(name, [positions], [expected["shape"]["vertices"]], exact))
    for stem, tolerance in (("animation", exact), ("long", expected["basis_tolerance"])):
        empty_scene()
        bpy.ops.import_scene.gltf(filepath=str(folder / f"{stem}.glb"))
        results.append(animation(f"{stem}.glb", y_up=True, tolerance=tolerance))

        empty_scene()
        bpy.ops.wm.obj_import(filepath=str(folder / "first.obj"), forward_axis="Y", up_axis="Z")
        modifier = the_mesh().modifiers.new("cache", "MESH_CACHE")
        modifier.cache_format, modifier.filepath = "PC2", str(folder / f"{stem}.pc2")
        modifier.forward_axis, modifier.up_axis, modifier.frame_start = "POS_Y", "POS_Z", 0
        results.append(animation(f"{stem}.pc2", y_up=False, tolerance=exact))

        empty_scene()
        bpy.ops.wm.usd_import(filepath=str(folder / f"{stem}.usd"))
        results.append(animation(f"{stem}.usd", y_up=True, tolerance=exact))
    return all(results)


if __name__ == "__main__":
    sys.exit(not main())

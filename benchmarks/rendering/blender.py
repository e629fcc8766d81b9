"""All that needs Blender: rendering, and carving and chamfering of solids."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import bpy  # before its parts

# isort: split
import bmesh
import mathutils
import numpy as np
from numpy.typing import NDArray

from rendering.cameras import FloatArray, View
from rendering.prints import PRINTS, TILE_MM
from rendering.scene import Light, Scene
from rendering.sensor import Pinhole
from rendering.solids import Finish, Solid

BAND_PX = 6_000_000
"""Fine pixels rendered at a time: 16 bytes each, several times over."""

SMOOTH_DEG = 20.0
TINY_MM = 2e-3
BOUNCES = 3


def carved(solid: Solid, tools: Sequence[Solid]) -> Solid:
    """Return a solid without what the tools take away."""
    body = _object(solid)
    for tool in tools:
        modifier = body.modifiers.new(tool.name, "BOOLEAN")
        modifier.operation, modifier.solver = "DIFFERENCE", "EXACT"
        modifier.object = _object(tool)
    return _read(body, solid)


def joined(solid: Solid, others: Sequence[Solid]) -> Solid:
    """Return the union of solids as one closed body."""
    body = _object(solid)
    for other in others:
        modifier = body.modifiers.new(other.name, "BOOLEAN")
        modifier.operation, modifier.solver = "UNION", "EXACT"
        modifier.object = _object(other)
    return _read(body, solid)


def chamfered(solid: Solid, width_mm: float) -> Solid:
    """Return a solid with flat chamfers on all sharp edges."""
    body = _object(solid)
    modifier = body.modifiers.new("chamfer", "BEVEL")
    modifier.width, modifier.segments = width_mm, 1
    modifier.limit_method, modifier.angle_limit = "ANGLE", math.radians(SMOOTH_DEG)
    modifier.use_clamp_overlap = False
    return _read(body, solid)


def _read(body: Any, solid: Solid) -> Solid:
    """Read a body back with all modifiers applied."""
    evaluated = body.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = evaluated.to_mesh()
    _tidy(mesh)
    mesh.calc_loop_triangles()
    vertices = np.array([vertex.co[:] for vertex in mesh.vertices], np.float64)
    faces = tuple(tuple(polygon.vertices) for polygon in mesh.polygons)
    triangles = np.array([corner.vertices[:] for corner in mesh.loop_triangles], np.int64)
    evaluated.to_mesh_clear()
    clear()
    return replace(solid, vertices_mm=vertices, faces=faces, triangles=triangles, marked=())


def _tidy(mesh: Any) -> None:
    """Dissolve edges without length and faces without area: they have no normal."""
    work = bmesh.new()
    work.from_mesh(mesh)
    bmesh.ops.remove_doubles(work, verts=work.verts, dist=TINY_MM)
    bmesh.ops.dissolve_degenerate(work, edges=work.edges, dist=TINY_MM)
    work.to_mesh(mesh)
    work.free()


def clear() -> None:
    """Empty Blender's scene."""
    for store in (bpy.data.objects, bpy.data.meshes, bpy.data.materials, bpy.data.lights):
        for item in list(store):
            store.remove(item)


def pictures(scene: Scene, view: View) -> tuple[NDArray[np.float32], Pinhole]:
    """Render the fine linear picture of one camera.

    Parameters
    ----------
    scene : Scene
        What to render.
    view : View
        Its camera.

    Returns
    -------
    picture : ndarray, shape (rows, columns), float32
        Linear light.
    pinhole : Pinhole
        Its geometry.
    """
    clear()
    for solid in (*scene.grounds, *scene.solids):
        mesh = _object(solid).data
        mesh.shade_smooth()
        mesh.set_sharp_from_angle(angle=math.radians(SMOOTH_DEG))
    for light in scene.lights:
        _light(light)
    _world(scene.ambient)
    pinhole = Pinhole.covering(view, scene.fineness)
    _cycles(scene)
    columns, rows = pinhole.size
    step = max(BAND_PX // columns, 1)
    with tempfile.TemporaryDirectory() as folder:
        bands = [
            _band(view, pinhole, (top, min(top + step, rows)), Path(folder) / f"{top}.exr")
            for top in range(0, rows, step)
        ]
    return np.concatenate(bands), pinhole


def _object(solid: Solid) -> Any:
    """Make a mesh object with materials and texture coordinates."""
    mesh = bpy.data.meshes.new(solid.name)
    mesh.from_pydata(solid.vertices_mm.tolist(), [], [list(face) for face in solid.faces])
    for finish in solid.finishes:
        mesh.materials.append(_material(finish))
    layer = mesh.uv_layers.new(name="mm")
    frames: dict[tuple[float, ...], tuple[FloatArray, FloatArray]] = {}
    for polygon, normal in zip(mesh.polygons, solid.normals(), strict=True):
        polygon.material_index = int(polygon.index in solid.marked)
        ring = solid.vertices_mm[list(polygon.vertices)]
        # a face with a hole is several polygons of one plane: print and grooves go through
        plane = tuple(np.round([*normal, normal @ ring[0]], 2).tolist())
        origin, axes = frames.setdefault(plane, _frame(ring, normal))
        flat = (ring - origin) @ axes
        for loop, uv in zip(polygon.loop_indices, flat / TILE_MM, strict=True):
            layer.data[loop].uv = uv.tolist()
    body = bpy.data.objects.new(solid.name, mesh)
    bpy.context.scene.collection.objects.link(body)
    return body


def _frame(ring: FloatArray, normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the first corner and two axes of a face, one along its first side; (3,), (3, 2)."""
    along = (ring[1] - ring[0]) / np.linalg.norm(ring[1] - ring[0])
    return ring[0], np.stack([along, np.cross(normal, along)], axis=1)


def _material(finish: Finish) -> Any:
    material = bpy.data.materials.new("finish")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    shader = nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (finish.grey,) * 3 + (1.0,)
    shader.inputs["Roughness"].default_value = finish.roughness
    shader.inputs["Metallic"].default_value = float(finish.metallic)
    if finish.print_name:
        texture = nodes.new("ShaderNodeTexImage")
        texture.image = _print(finish.print_name)
        links.new(texture.outputs["Color"], shader.inputs["Base Color"])
    if finish.metallic:
        _milling(nodes, links, shader)
    return material


def _milling(nodes: Any, links: Any, shader: Any) -> None:
    """Add fine grooves along one direction: highlights spread across them."""
    shader.inputs["Anisotropic"].default_value = 0.5
    tangent = nodes.new("ShaderNodeTangent")
    tangent.direction_type, tangent.uv_map = "UV_MAP", "mm"
    links.new(tangent.outputs["Tangent"], shader.inputs["Tangent"])
    place = nodes.new("ShaderNodeUVMap")
    stretch = nodes.new("ShaderNodeMapping")
    stretch.inputs["Scale"].default_value = (3.0, 160.0, 1.0)
    noise, bump = nodes.new("ShaderNodeTexNoise"), nodes.new("ShaderNodeBump")
    noise.inputs["Scale"].default_value = 1.0
    bump.inputs["Strength"].default_value = 0.12
    bump.inputs["Distance"].default_value = 0.05
    links.new(place.outputs["UV"], stretch.inputs["Vector"])
    links.new(stretch.outputs["Vector"], noise.inputs["Vector"])
    links.new(noise.outputs["Fac"], bump.inputs["Height"])
    links.new(bump.outputs["Normal"], shader.inputs["Normal"])


def _print(name: str) -> Any:
    if name in bpy.data.images:
        return bpy.data.images[name]
    tile = PRINTS[name]()
    image = bpy.data.images.new(name, tile.shape[1], tile.shape[0], float_buffer=True)
    image.colorspace_settings.name = "Non-Color"
    pixels = np.ones((*tile.shape, 4), np.float32)
    pixels[..., :3] = tile[..., None]
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    return image


def _light(light: Light) -> None:
    lamp = bpy.data.lights.new("light", "AREA")
    lamp.shape = "RECTANGLE"
    lamp.size, lamp.size_y = light.size_mm
    lamp.energy = light.radiance * math.pi * light.size_mm[0] * light.size_mm[1]
    body = bpy.data.objects.new("light", lamp)
    way = mathutils.Vector(np.subtract(light.target_mm, light.centre_mm).tolist())
    body.location = light.centre_mm
    body.rotation_euler = way.to_track_quat("-Z", "Y").to_euler()
    bpy.context.scene.collection.objects.link(body)


def _world(ambient: float) -> None:
    world = bpy.context.scene.world or bpy.data.worlds.new("world")
    bpy.context.scene.world = world
    world.use_nodes = True
    background = world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (ambient,) * 3 + (1.0,)


def _cycles(scene: Scene) -> None:
    settings = bpy.context.scene
    settings.render.engine = "CYCLES"
    settings.render.use_persistent_data = True
    settings.render.image_settings.file_format = "OPEN_EXR"
    settings.render.image_settings.color_mode = "RGB"
    settings.render.image_settings.color_depth = "32"
    cycles = settings.cycles
    cycles.device, cycles.samples, cycles.seed = "CPU", scene.samples, scene.seed
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.pixel_filter_type, cycles.filter_width = "BOX", 1.0
    cycles.max_bounces = BOUNCES
    cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.sample_clamp_indirect = 20.0


def _band(view: View, pinhole: Pinhole, rows: tuple[int, int], path: Path) -> NDArray[np.float32]:
    """Render some rows of the fine picture."""
    settings = bpy.context.scene
    columns, count = pinhole.size[0], rows[1] - rows[0]
    lens = bpy.data.cameras.new("band")
    lens.sensor_fit, lens.sensor_width = "HORIZONTAL", 36.0
    lens.lens = pinhole.focal / columns * 36.0
    # the principal point from the middle of the band, in units of its width
    lens.shift_x = (columns / 2 - pinhole.principal[0] - 0.5) / columns
    lens.shift_y = (pinhole.principal[1] + 0.5 - rows[0] - count / 2) / columns
    lens.clip_start, lens.clip_end = 10.0, 20000.0
    body = bpy.data.objects.new("band", lens)
    pose = np.eye(4)
    pose[:3, :3] = view.rotation.T * np.array([1, -1, -1])  # Blender looks along -Z, Y is up
    pose[:3, 3] = view.centre_mm
    body.matrix_world = mathutils.Matrix(pose.tolist())
    settings.collection.objects.link(body)
    settings.camera = body
    settings.render.resolution_x, settings.render.resolution_y = columns, count
    settings.render.resolution_percentage = 100
    settings.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(str(path))
    pixels = np.empty(columns * count * 4, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    bpy.data.objects.remove(body)
    return np.ascontiguousarray(pixels.reshape(count, columns, 4)[::-1, :, 1])

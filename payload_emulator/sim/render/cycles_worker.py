"""Run inside an interpreter that has Blender: builds a described scene and renders it with Cycles.

    python cycles_worker.py SCENE.npz OUT.exr PICTURE.png COST.json

A separate program: it imports numpy and Blender's ``bpy`` and nothing of this project, so that Blender (GPL, with
its own version of numpy) never shares a process with the rest.  `cycles_scene.CyclesScene` says what the scene holds.
OUT.exr takes scene-linear radiance and the passes, PICTURE.png the Filmic picture in 16 bits, COST.json seconds.
Exit status 3: there is no ``bpy``.
"""

import json
import math
import os
import sys
import time
from typing import Any

NO_BLENDER = 3


def main(scene_path: str, exr_path: str, png_path: str, cost_path: str) -> int:
    try:
        import bpy
    except ImportError as error:
        print(f"{error}", file=sys.stderr)
        return NO_BLENDER
    import numpy as np

    with np.load(scene_path) as file:
        scene_values = {name: file[name] for name in file.files}
    marks = [_seconds()]
    scene = bpy.context.scene
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    _set_up(bpy, scene, scene_values)
    _add_ground(bpy, scene, scene_values)
    _add_camera(bpy, scene, scene_values)
    _add_sun(bpy, scene, scene_values)
    marks.append(_seconds())
    scene.render.filepath = exr_path
    _file_format(scene, "MULTI_LAYER_IMAGE", "OPEN_EXR_MULTILAYER", "RGBA", "32")
    bpy.ops.render.render(write_still=True)
    marks.append(_seconds())
    _file_format(scene, "IMAGE", "PNG", "RGB", "16")
    bpy.data.images["Render Result"].save_render(png_path, scene=scene)
    cost = {
        "blender": bpy.app.version_string,
        "scene_wall_s": marks[1][0] - marks[0][0],
        "render_wall_s": marks[2][0] - marks[1][0],
        "render_cpu_s": marks[2][1] - marks[1][1],
    }
    with open(cost_path, "w", encoding="utf-8") as file:
        json.dump(cost, file)
    return 0


def _seconds() -> tuple[float, float]:
    spent = os.times()
    return time.monotonic(), spent.user + spent.system


def _set_up(bpy: Any, scene: Any, scene_values: Any) -> None:
    render, cycles, layer = scene.render, scene.cycles, scene.view_layers[0]
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y = int(scene_values["width_px"]), int(scene_values["height_px"])
    render.resolution_percentage = 100
    render.film_transparent = True
    render.use_compositing = render.use_sequencer = False
    if scene_values["set_threads"] > 0:
        render.threads_mode, render.threads = "FIXED", int(scene_values["set_threads"])
    cycles.device = "CPU"
    cycles.samples = int(scene_values["set_samples"])
    cycles.seed = int(scene_values["set_seed"])
    cycles.use_adaptive_sampling = True
    cycles.adaptive_threshold = float(scene_values["set_noise_threshold"])
    cycles.filter_width = float(scene_values["set_filter_px"])
    cycles.use_denoising = bool(scene_values["set_denoise"])
    if cycles.use_denoising:
        cycles.denoiser = "OPENIMAGEDENOISE"
        cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"
    cycles.max_bounces = cycles.diffuse_bounces = int(scene_values["set_diffuse_bounces"])
    cycles.glossy_bounces = 1
    # Micropolygons: the modifier says how many pixels each, these two by how much to multiply that.
    cycles.dicing_rate = 1.0
    cycles.offscreen_dicing_scale = float(scene_values["set_offscreen_dicing"])
    cycles.max_subdivisions = 12
    layer.use_pass_position = layer.use_pass_normal = layer.use_pass_diffuse_direct = True
    scene.world = bpy.data.worlds.new("vacuum")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.0
    scene.display_settings.display_device = "sRGB"
    scene.view_settings.view_transform = "Filmic"
    scene.view_settings.look = "None"
    scene.view_settings.exposure = float(scene_values["exposure_stops"])


def _file_format(scene: Any, media: str, file_format: str, colours: str, depth: str) -> None:
    image = scene.render.image_settings
    image.media_type = media
    image.file_format = file_format
    image.color_mode = colours
    image.color_depth = depth
    if media == "MULTI_LAYER_IMAGE":
        image.exr_codec = "NONE"
        image.use_exr_interleave = True


def _add_ground(bpy: Any, scene: Any, scene_values: Any) -> None:
    import numpy as np

    vertices, uv = scene_values["vertices_km"], scene_values["uv"]
    rows, columns = vertices.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    # Counter-clockwise from above: the normals point up.
    faces = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1).reshape(-1, 4)
    mesh = bpy.data.meshes.new("cap")
    mesh.from_pydata(vertices.reshape(-1, 3).tolist(), [], faces.tolist())
    mesh.polygons.foreach_set("use_smooth", np.ones(len(faces), dtype=bool))
    layer = mesh.uv_layers.new(name="map")
    layer.data.foreach_set("uv", np.asarray(uv.reshape(-1, 2)[faces.ravel()], dtype=np.float32).ravel())
    mesh.update()
    mesh.materials.append(_regolith(bpy, scene_values))
    ground = bpy.data.objects.new("ground", mesh)
    scene.collection.objects.link(ground)
    ground.cycles.shadow_terminator_offset = float(scene_values["set_terminator_offset"])
    ground.cycles.shadow_terminator_geometry_offset = float(scene_values["set_geometry_offset"])
    modifier = ground.modifiers.new("dicing", "SUBSURF")
    modifier.subdivision_type = "SIMPLE"
    modifier.uv_smooth = "NONE"
    modifier.use_adaptive_subdivision = True
    modifier.adaptive_space = "PIXEL"
    modifier.adaptive_pixel_size = float(scene_values["set_pixels_per_polygon"])


def _regolith(bpy: Any, scene_values: Any) -> Any:
    material = bpy.data.materials.new("regolith")
    material.use_nodes = True
    material.displacement_method = "DISPLACEMENT"
    nodes, links = material.node_tree.nodes, material.node_tree.links
    surface = nodes["Principled BSDF"]
    surface.inputs["Roughness"].default_value = float(scene_values["set_roughness"])
    surface.inputs["IOR"].default_value = float(scene_values["specular_ior"])
    links.new(_texture(bpy, nodes, "albedo", scene_values["albedo"]).outputs["Color"], surface.inputs["Base Color"])
    relief = nodes.new("ShaderNodeDisplacement")
    relief.space = "OBJECT"
    relief.inputs["Midlevel"].default_value = 0.5
    relief.inputs["Scale"].default_value = float(scene_values["displacement_range_km"])
    height = _texture(bpy, nodes, "height", scene_values["displacement"])
    links.new(height.outputs["Color"], relief.inputs["Height"])
    links.new(relief.outputs["Displacement"], nodes["Material Output"].inputs["Displacement"])
    return material


def _texture(bpy: Any, nodes: Any, name: str, values: Any) -> Any:
    import numpy as np

    high, wide = values.shape
    image = bpy.data.images.new(name, wide, high, alpha=False, float_buffer=True, is_data=True)
    pixels = np.ones((high, wide, 4), np.float32)
    pixels[..., :3] = values[..., None]
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    node = nodes.new("ShaderNodeTexImage")
    node.image = image
    node.interpolation = "Linear"
    node.extension = "EXTEND"
    return node


def _add_camera(bpy: Any, scene: Any, scene_values: Any) -> None:
    from mathutils import Matrix

    lens = bpy.data.cameras.new("camera")
    lens.type = "PERSP"
    lens.sensor_fit = "HORIZONTAL"
    lens.angle = float(scene_values["fov_rad"])
    lens.clip_start, lens.clip_end = 0.01, 1.0e4
    camera = bpy.data.objects.new("camera", lens)
    camera.matrix_world = Matrix(scene_values["camera_to_world"].tolist())
    scene.collection.objects.link(camera)
    scene.camera = camera


def _add_sun(bpy: Any, scene: Any, scene_values: Any) -> None:
    from mathutils import Matrix

    lamp = bpy.data.lights.new("Sun", "SUN")
    # Irradiance of pi: a white Lambert surface under it has radiance 1.
    lamp.energy = math.pi
    lamp.angle = float(scene_values["sun_angle_rad"])
    sun = bpy.data.objects.new("Sun", lamp)
    sun.matrix_world = Matrix(scene_values["sun_to_world"].tolist())
    scene.collection.objects.link(sun)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:5]))

"""Read looks from the materials of a stage, and write them as such."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

from pxr import Ar, Gf, Sdf, Usd, UsdShade

from ..files import whole_file
from ..looks import Look, Placing, Texture, Value

log = logging.getLogger("warpjelly")

# Inputs of UsdPreviewSurface that are read and written.
_COLORS = ("diffuseColor", "emissiveColor", "specularColor")
_FLOATS = (
    "roughness",
    "metallic",
    "clearcoat",
    "clearcoatRoughness",
    "opacity",
    "opacityThreshold",
    "ior",
    "occlusion",
)
_TYPES = {
    **dict.fromkeys(_COLORS, Sdf.ValueTypeNames.Color3f),
    **dict.fromkeys(_FLOATS, Sdf.ValueTypeNames.Float),
    "normal": Sdf.ValueTypeNames.Normal3f,
    "useSpecularWorkflow": Sdf.ValueTypeNames.Int,
}


def read_look(file: Path, material: UsdShade.Material, images: dict[str, bytes]) -> Look | None:
    """Read a material that is a UsdPreviewSurface; None, after a warning, if it is another one.

    Args:
        file: the stage, for warnings.
        material: the material.
        images: what was read of images so far, by path; what is read now is added.
    """
    shader, path = material.ComputeSurfaceSource()[0], material.GetPath()
    if not shader or shader.GetShaderId() != "UsdPreviewSurface":
        log.warning("%s: material %s is left out, because it is not a UsdPreviewSurface", file, path)
        return None
    values = {name: _look_value(file, shader, name, images) for name in _TYPES}
    return Look(path.name, {name: value for name, value in values.items() if value is not None})


def _look_value(file: Path, shader: UsdShade.Shader, name: str, images: dict[str, bytes]) -> Value | None:
    """Return what an input of a surface is; None if it has the default."""
    source = _source(shader, name)
    if not source:
        return None
    if UsdShade.Utils.GetType(source.GetName()) == UsdShade.AttributeType.Output:
        return _texture(file, source, name, images)
    value = _value(source)
    try:
        if name == "useSpecularWorkflow":
            return int(value)
        if name in _FLOATS:
            return float(value)
        red, green, blue = map(float, value)
        return red, green, blue
    except (TypeError, ValueError):
        log.warning("%s: %s is of another type; left out", file, source.GetPath())
        return None


def _texture(file: Path, output: Usd.Attribute, name: str, images: dict[str, bytes]) -> Texture | None:
    """Read the texture that gives an input its value; None, after a warning, if there is none to be had."""
    shader = UsdShade.Shader(output.GetPrim())
    if shader.GetShaderId() != "UsdUVTexture":
        log.warning("%s: %s is left out, because it is not a UsdUVTexture", file, shader.GetPath())
        return None
    asset = _input(shader, "file", Sdf.AssetPath())
    path = asset.resolvedPath
    if path and path not in images and (opened := Ar.GetResolver().OpenAsset(Ar.ResolvedPath(path))):
        images[path] = bytes(opened.GetBuffer())
    if path not in images:
        log.warning("%s: %s: the texture %s is missing", file, shader.GetPath(), asset.path)
        return None
    space = _input(shader, "sourceColorSpace", "auto")
    wrap = (_input(shader, "wrapS", "useMetadata"), _input(shader, "wrapT", "useMetadata"))
    return Texture(
        asset_name(asset.path),
        images[path],
        UsdShade.Output(output).GetBaseName(),
        space == "sRGB" or (space == "auto" and name in _COLORS),
        wrap,
        tuple(_input(shader, "scale", (1.0, 1.0, 1.0, 1.0))),
        tuple(_input(shader, "bias", (0.0, 0.0, 0.0, 0.0))),
        _placing(shader),
    )


def _placing(texture: UsdShade.Shader) -> Placing:
    """Return what is done to the UVs of a texture."""
    source = _source(texture, "st")
    shader = UsdShade.Shader(source.GetPrim()) if source else None
    if not shader or shader.GetShaderId() != "UsdTransform2d":
        return Placing()
    scale, translation = _input(shader, "scale", (1.0, 1.0)), _input(shader, "translation", (0.0, 0.0))
    return Placing(_input(shader, "rotation", 0.0), (scale[0], scale[1]), (translation[0], translation[1]))


def _source(shader: UsdShade.Shader, name: str) -> Usd.Attribute | None:
    """Return the attribute that an input has its value from, through all that is connected."""
    shader_input = shader.GetInput(name)
    return next(iter(UsdShade.Utils.GetValueProducingAttributes(shader_input)), None) if shader_input else None


def _input(shader: UsdShade.Shader, name: str, default: Any) -> Any:
    source = _source(shader, name)
    value = _value(source) if source else None
    return default if value is None else value


def _value(attribute: Usd.Attribute) -> Any:
    """Return the value at rest."""
    value = attribute.Get()
    return attribute.Get(Usd.TimeCode.EarliestTime()) if value is None else value


def define_look(stage: Usd.Stage, path: Sdf.Path, look: Look, texture_folder: Path) -> UsdShade.Material:
    """Write a look as a material whose textures are at the primvar ``st``.

    Args:
        stage: the stage, which is saved or exported beside the folder.
        path: where the material will be.
        look: what it is.
        texture_folder: where its images are written, as files that several looks share where they are equal.

    Raises:
        OSError: an image cannot be written.
    """
    material = UsdShade.Material.Define(stage, path)
    surface = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("surface"))
    surface.CreateIdAttr("UsdPreviewSurface")
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    shaders: dict[Texture, UsdShade.Shader] = {}
    for name, value in look.inputs.items():
        shader_input = surface.CreateInput(name, _TYPES[name])
        if not isinstance(value, Texture):
            shader_input.Set(Gf.Vec3f(*value) if isinstance(value, tuple) else value)
            continue
        image = value.of("rgb")
        if image not in shaders:
            file = f"./{texture_folder.name}/{store_image(texture_folder, image.name, image.data)}"
            shaders[image] = _define_texture(material, f"{name}_texture", image, file)
        kind = Sdf.ValueTypeNames.Float3 if value.channel == "rgb" else Sdf.ValueTypeNames.Float
        shader_input.ConnectToSource(shaders[image].CreateOutput(value.channel, kind))
    return material


def _define_texture(material: UsdShade.Material, name: str, texture: Texture, file: str) -> UsdShade.Shader:
    stage, path = material.GetPrim().GetStage(), material.GetPath()
    types = Sdf.ValueTypeNames
    reader = UsdShade.Shader.Define(stage, path.AppendChild("st"))
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", types.String).Set("st")
    uvs = reader.CreateOutput("result", types.Float2)
    if texture.placing != Placing():
        transform = UsdShade.Shader.Define(stage, path.AppendChild(f"{name}_placing"))
        transform.CreateIdAttr("UsdTransform2d")
        transform.CreateInput("in", types.Float2).ConnectToSource(uvs)
        transform.CreateInput("rotation", types.Float).Set(texture.placing.rotation)
        transform.CreateInput("scale", types.Float2).Set(Gf.Vec2f(*texture.placing.scale))
        transform.CreateInput("translation", types.Float2).Set(Gf.Vec2f(*texture.placing.translation))
        uvs = transform.CreateOutput("result", types.Float2)
    shader = UsdShade.Shader.Define(stage, path.AppendChild(name))
    shader.CreateIdAttr("UsdUVTexture")
    shader.CreateInput("st", types.Float2).ConnectToSource(uvs)
    shader.CreateInput("file", types.Asset).Set(file)
    shader.CreateInput("sourceColorSpace", types.Token).Set("sRGB" if texture.srgb else "raw")
    for key, wrap in zip(("wrapS", "wrapT"), texture.wrap, strict=True):
        shader.CreateInput(key, types.Token).Set(wrap)
    shader.CreateInput("scale", types.Float4).Set(Gf.Vec4f(*texture.scale))
    shader.CreateInput("bias", types.Float4).Set(Gf.Vec4f(*texture.bias))
    return shader


def store_image(folder: Path, name: str, data: bytes) -> str:
    """Write an image into a folder, which is made if missing, unless it is there; return the name of its file.

    Args:
        folder: where to.
        name: that of the image, anything; the file gets one that is close to it and not taken.
        data: the contents of the file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for file in sorted(folder.iterdir()):
        if file.is_file() and file.stat().st_size == len(data) and file.read_bytes() == data:
            return file.name
    safe = Path(re.sub(r"[^\w.-]+", "_", name, flags=re.ASCII).lstrip(".") or "texture")
    names = [safe.name, *(f"{safe.stem}_{k}{safe.suffix}" for k in range(1, 1 + sum(1 for _ in folder.iterdir())))]
    file = folder / next(one for one in names if not (folder / one).exists())
    with whole_file(file) as unfinished:
        unfinished.write_bytes(data)
    return file.name


def asset_name(path: str) -> str:
    """Return the name of the file that an asset path names, also of one in a package."""
    return re.split(r"[/\\\[\]]", path.rstrip("]"))[-1]

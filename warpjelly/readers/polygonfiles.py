"""Read the polygons of OBJ, OFF and PLY files; colours of vertices and faces are passed over."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from pathlib import Path

import numpy as np

from ..looks import Look
from ..polygons import Model, from_polygons
from .mtlfile import read_mtl

log = logging.getLogger("warpjelly")

# How many numbers of a vertex, a texture coordinate and a normal are read, and what stands for no index.
_OBJ_WIDTHS = {"v": 3, "vt": 2, "vn": 3}
_NONE = np.iinfo(np.int64).min

_PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
# Names of a vertex's UVs, by the programs that write them.
_PLY_UVS = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
_PLY_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}

# A property of an element of a PLY file: its name, its type and, of a list, the type of its length.
_Property = tuple[str, str, str | None]


@dataclass
class _Obj:
    """What is read of an OBJ file so far."""

    tables: dict[str, list[list[float]]] = field(default_factory=lambda: {"v": [], "vt": [], "vn": []})
    """Vertices, UVs and normals."""
    indices: list[list[int]] = field(default_factory=list)
    """Which of each kinds of corners have, or _NONE."""
    corners: list[int] = field(default_factory=list)
    """Kind of each corner: most are written alike several times."""
    counts: list[int] = field(default_factory=list)
    """Number of corners of each polygon."""
    groups: list[int] = field(default_factory=list)
    """Group of each polygon."""
    group_numbers: dict[tuple[tuple[str, ...], ...], int] = field(default_factory=dict)
    """Number of each group, by the names of object, groups and material."""
    state: dict[str, tuple[str, ...]] = field(default_factory=lambda: {"o": (), "g": (), "usemtl": ()})
    """The names that the next polygons have."""
    libraries: list[str] = field(default_factory=list)
    """Names of files of materials."""
    known_words: dict[str, int] = field(default_factory=dict)
    """Kinds of corners by what is written."""

    def read(self, words: list[str]) -> None:
        """Read a line.

        Raises:
            ValueError: it is wrong.
        """
        kind = words[0]
        if kind in self.tables:
            values = [float(word) for word in words[1 : 1 + _OBJ_WIDTHS[kind]]]
            if kind == "vt" and len(values) == 1:
                values.append(0.0)
            if len(values) < _OBJ_WIDTHS[kind]:
                raise ValueError(f"{kind} needs {_OBJ_WIDTHS[kind]} numbers")
            self.tables[kind].append(values)
        elif kind == "f":
            self.counts.append(len(words) - 1)
            self.corners += [self.corner(word) for word in words[1:]]
            self.groups.append(self.group_numbers.setdefault(tuple(self.state.values()), len(self.group_numbers)))
        elif kind == "g":
            self.state["g"] = tuple(words[1:])
        elif kind in self.state:
            self.state[kind] = (" ".join(words[1:]),)
        elif kind == "mtllib":
            self.libraries.append(" ".join(words[1:]))

    def corner(self, word: str) -> int:
        """Return the kind of a corner that is written like 1/2/3."""
        if word in self.known_words:
            return self.known_words[word]
        written = zip_longest(word.split("/")[:3], self.tables.values(), fillvalue="")
        self.indices.append([_obj_index(index, len(table)) for index, table in written])
        # What counts back means something else further down.
        if "-" not in word:
            self.known_words[word] = len(self.indices) - 1
        return len(self.indices) - 1


def _obj_index(word: str, count: int) -> int:
    """Return which of so many values is meant, or _NONE; negative numbers count back from the last one."""
    if not word:
        return _NONE
    index = int(word)
    if index == 0:
        raise ValueError("vertices are numbered from 1")
    return index - 1 if index > 0 else count + index


def read_obj(path: Path) -> Model:
    """Read the polygons of all objects of an OBJ file, with their groups and materials.

    Raises:
        ValueError: a line is wrong; the message has its number.
    """
    text = path.read_text(encoding="utf-8-sig", errors="replace").replace("\\\n", " ")
    obj = _Obj()
    for number, line in enumerate(text.split("\n"), 1):
        if words := (line.split("#", 1)[0] if "#" in line else line).split():
            try:
                obj.read(words)
            except ValueError as error:
                raise ValueError(f"line {number}: {error}") from error
    looks = _obj_looks(path, obj.libraries, {name for *_, names in obj.group_numbers for name in names})
    look_numbers = {look.name: k for k, look in enumerate(looks)}
    group_looks = np.array([look_numbers.get("".join(names), -1) for *_, names in obj.group_numbers], np.int64)
    points, uvs, normals = np.array(obj.indices, np.int64).reshape(-1, 3)[obj.corners].T
    part = from_polygons(
        np.array(obj.tables["v"], float).reshape(-1, 3),
        obj.counts,
        points,
        uvs=_at_corners(path, obj.tables["vt"], uvs, "texture coordinates"),
        normals=_at_corners(path, obj.tables["vn"], normals, "normals"),
        looks=group_looks[obj.groups],
        groups=obj.groups,
        names=[(*object_name, *groups, *material) for object_name, groups, material in obj.group_numbers],
    )
    return Model([part], looks)


def obj_libraries(path: Path) -> list[Path]:
    """Return the files of materials that an OBJ file names, whether or not they are there."""
    lines = re.findall(rb"^(?:\xef\xbb\xbf)?[ \t]*mtllib[ \t]([^#\r\n]*)", path.read_bytes(), re.MULTILINE)
    names = (" ".join(line.decode(errors="replace").split()) for line in lines)
    return [file for name in names for file in _library_files(path, name)]


def _library_files(path: Path, names: str) -> list[Path]:
    # A name may have spaces, and there may be several names.
    whole = os.path.exists(path.parent / names)
    return [path.parent / name.replace("\\", "/") for name in ([names] if whole else names.split())]


def _obj_looks(path: Path, libraries: list[str], names: set[str]) -> list[Look]:
    """Read the materials that an OBJ file uses."""
    looks: dict[str, Look] = {}
    for library in libraries:
        for file in _library_files(path, library):
            looks |= {look.name: look for look in read_mtl(path, file)}
    unknown = sorted(names - looks.keys())
    if unknown and looks:
        log.warning("%s: materials that are in none of its files: %s", path, ", ".join(unknown))
    return list(looks.values())


def _at_corners(path: Path, values: list[list[float]], indices: np.ndarray, name: str) -> np.ndarray | None:
    """Return the value at each corner, NaN where there is none; None where there is none at all."""
    table = np.array(values, float)
    sound = (indices >= 0) & (indices < len(table))
    if lost := int(np.count_nonzero(~sound & (indices != _NONE))):
        log.warning("%s: %d corners have %s that do not exist", path, lost, name)
    if not sound.any():
        return None
    found = np.full((len(indices), table.shape[1]), np.nan)
    found[sound] = table[indices[sound]]
    return found


def read_off(path: Path) -> Model:
    """Read the polygons of an OFF file.

    Raises:
        ValueError: it is none.
    """
    text = re.sub(r"#.*", "", path.read_text(encoding="utf-8-sig", errors="replace")).strip()
    header = re.match(r"(ST)?C?N?OFF\b(?!\s+BINARY)", text)
    if not header:
        raise ValueError("it does not start with OFF")
    lines = [words for line in text[header.end() :].split("\n") if (words := line.split())]
    if not lines or len(lines[0]) < 2:
        raise ValueError("the numbers of vertices and faces are missing")
    vertex_count, face_count = int(lines[0][0]), int(lines[0][1])
    if len(lines) <= vertex_count + face_count:
        raise ValueError(f"it ends before its {vertex_count} vertices and {face_count} faces")
    vertices = np.array([words[:3] for words in lines[1 : vertex_count + 1]], float).reshape(-1, 3)
    faces = lines[vertex_count + 1 : vertex_count + face_count + 1]
    counts = [int(words[0]) for words in faces]
    corners = [int(word) for words, count in zip(faces, counts, strict=True) for word in words[1 : count + 1]]
    if len(corners) != sum(counts):
        raise ValueError("a face has fewer vertices than it says")
    return Model([from_polygons(vertices, counts, corners)])


def read_ply(path: Path) -> Model:
    """Read the polygons of a PLY file, text or binary.

    Raises:
        ValueError: it is none, or it ends too early.
    """
    data = path.read_bytes()
    header = re.match(rb"ply\s.*?\nend_header[^\n]*\n", data, re.DOTALL)
    if not header:
        raise ValueError("it does not start with the header of a PLY file")
    order, elements = _ply_header(header[0].decode("ascii", "replace"))
    # The words of a text file take the place of the bytes of a binary one.
    rest = data[header.end() :]
    body = np.array(rest.split(), float) if order == "=" else np.frombuffer(rest, np.uint8)
    vertices, counts, corners = np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64)
    normals = uvs = None
    at = 0
    for name, count, properties in elements:
        values, at = _ply_element(body, at, count, properties, order)
        if name == "vertex":
            vertices = _ply_columns(values, ("x", "y", "z"))
            normals = _ply_columns(values, ("nx", "ny", "nz")) if "nx" in values else None
            uvs = next((_ply_columns(values, pair) for pair in _PLY_UVS if values.keys() >= {*pair}), None)
        elif name == "face":
            counts, corners = values["vertex_indices" if "vertex_indices" in values else "vertex_index"]
    part = from_polygons(vertices, counts, corners)
    uvs, normals = (None if values is None else values[part.corners] for values in (uvs, normals))
    return Model([replace(part, uvs=uvs, normals=normals)])


def _ply_columns(values: dict[str, tuple[np.ndarray, np.ndarray]], names: Sequence[str]) -> np.ndarray:
    """Return some properties of all vertices, float64 [vertex_count, len(names)]."""
    return np.stack([np.asarray(values[name][1], float) for name in names], axis=1)


def _ply_header(text: str) -> tuple[str, list[tuple[str, int, list[_Property]]]]:
    """Return the byte order, "=" for text, and of each element its name, its number and its properties."""
    order, elements = "", []
    for line in text.splitlines():
        match line.split():
            case ["format", name, _]:
                order = _PLY_ORDERS.get(name, "")
            case ["element", name, count]:
                elements.append((name, int(count), list[_Property]()))
            case ["property", "list", length, kind, name] if elements:
                elements[-1][2].append((name, _PLY_TYPES[kind], _PLY_TYPES[length]))
            case ["property", kind, name] if elements:
                elements[-1][2].append((name, _PLY_TYPES[kind], None))
    if not order:
        raise ValueError("its format is unknown")
    return order, elements


def _ply_element(
    body: np.ndarray, at: int, count: int, properties: list[_Property], order: str
) -> tuple[dict[str, tuple[np.ndarray, np.ndarray]], int]:
    """Read all of an element: of each property the lengths and the values, one after the other; and where it ends.

    Args:
        body: the words or the bytes of the file.
        at: where the element starts in it.
        count: how many there are.
        properties: what each of them has.
        order: the byte order, "=" for text.
    """

    def kind(name: str) -> np.dtype:
        return np.dtype("f8" if order == "=" else order + name)

    def take(row: int, name: str, length: int) -> tuple[np.ndarray, int]:
        end = row + length * (kind(name).itemsize // body.itemsize)
        if length < 0 or end > len(body):
            raise ValueError("it ends too early")
        return body[row:end].view(kind(name)), end

    if not (count and properties):
        return {name: (np.zeros(0, np.int64), np.zeros(0)) for name, _, _ in properties}, at
    # Most often all lists are as long as the first ones. Then all can be read at once.
    layout, row = [], at
    for name, value, length in properties:
        size = 1
        if length:
            first, row = take(row, length, 1)
            size = int(first[0])
            layout.append((f"{name} length", kind(length), (1,)))
        layout.append((name, kind(value), (size,)))
        _, row = take(row, value, size)
    table = np.dtype(layout)
    end = at + count * (table.itemsize // body.itemsize)
    if end <= len(body):
        rows = body[at:end].view(table)
        if all((rows[f"{name} length"] == rows[name].shape[1]).all() for name, _, length in properties if length):
            read = {name: rows[name] for name, _, _ in properties}
            return {name: (np.full(count, part.shape[1]), part.ravel()) for name, part in read.items()}, end
    lengths: dict[str, list[int]] = {name: [] for name, _, _ in properties}
    values: dict[str, list[np.ndarray]] = {name: [] for name, _, _ in properties}
    for _ in range(count):
        for name, value, length in properties:
            size = 1
            if length:
                first, at = take(at, length, 1)
                size = int(first[0])
            part, at = take(at, value, size)
            lengths[name].append(size)
            values[name].append(part)
    return {name: (np.array(lengths[name]), np.concatenate(values[name])) for name in lengths}, at

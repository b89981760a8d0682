"""Read the polygons of OBJ, OFF and PLY files; colours, normals and materials are passed over."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from .polygons import Part, from_polygons

_PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_PLY_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}

# A property of an element of a PLY file: its name, its type and, of a list, the type of its length.
_Property = tuple[str, str, str | None]


def read_obj(path: Path) -> Part:
    """Read the polygons of all objects of an OBJ file.

    Raises:
        ValueError: a line is wrong; the message has its number.
    """
    text = path.read_text(encoding="utf-8", errors="replace").replace("\\\n", " ")
    vertices: list[list[float]] = []
    counts: list[int] = []
    corners: list[int] = []
    for number, line in enumerate(text.split("\n"), 1):
        words = (line.split("#", 1)[0] if "#" in line else line).split()
        try:
            if words[:1] == ["v"]:
                x, y, z = words[1:4]
                vertices.append([float(x), float(y), float(z)])
            elif words[:1] == ["f"]:
                indices = [int(word.split("/", 1)[0] if "/" in word else word) for word in words[1:]]
                if 0 in indices:
                    raise ValueError("vertices are numbered from 1")
                counts.append(len(indices))
                # Negative numbers count back from the vertex that was read last.
                corners += [index - 1 if index > 0 else len(vertices) + index for index in indices]
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from error
    return from_polygons(np.array(vertices, float).reshape(-1, 3), counts, corners)


def read_off(path: Path) -> Part:
    """Read the polygons of an OFF file.

    Raises:
        ValueError: it is none.
    """
    text = re.sub(r"#.*", "", path.read_text(encoding="utf-8", errors="replace")).strip()
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
    return from_polygons(vertices, counts, corners)


def read_ply(path: Path) -> Part:
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
    at = 0
    for name, count, properties in elements:
        values, at = _ply_element(body, at, count, properties, order)
        if name == "vertex":
            vertices = np.stack([np.asarray(values[axis][1], float) for axis in "xyz"], axis=1)
        elif name == "face":
            counts, corners = values["vertex_indices" if "vertex_indices" in values else "vertex_index"]
    return from_polygons(vertices, counts, corners)


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

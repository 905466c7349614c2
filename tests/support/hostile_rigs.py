"""Layers and rigs that are small files and take much memory or time to read."""

from pathlib import Path

from pxr import Sdf, Vt

HEADER = "#usda 1.0\n"


def doubling(levels: int) -> str:
    """Return a layer of 2 ** levels prims."""
    half = 'def "{}" ( references = </P{}> ) {{}}\n'
    lines = [f'def "P{i}" {{\n{half.format("a", i + 1)}{half.format("b", i + 1)}}}\n' for i in range(levels)]
    return HEADER + "".join(lines) + f'def "P{levels}" {{}}\n'


def nested(levels: int) -> str:
    """Return a layer that makes OpenUSD overflow its stack."""
    return HEADER + 'def "a" {\n' * levels + "}\n" * levels


def enlarge(layer: Path, attribute: str, count: int) -> None:
    """Fill an array of a binary layer with zeros; the file stays small."""
    opened = Sdf.Layer.FindOrOpen(str(layer))
    spec = opened.GetAttributeAtPath(attribute)
    kind = Vt.IntArray if spec.typeName == Sdf.ValueTypeNames.IntArray else Vt.DoubleArray
    spec.default = kind(count)
    large = layer.with_name("large.usdc")
    opened.Export(str(large))
    large.replace(layer)

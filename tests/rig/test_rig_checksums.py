"""Damage in a rig's binary layers is found when it is opened; rigs without checksums still open."""

import subprocess
import sys

import numpy as np
import pytest
from example_rig import FPS, assert_valid_usd, forget_checksums
from pxr import Sdf

from jawusd.base.errors import RigError
from jawusd.rig import describe, load_rig, validate_stage, write_animation
from jawusd.rig.asset_paths import CHECKSUMS
from jawusd.rig.publish import publish_rig


def flip_bits(file):
    """Damage one byte in the middle, like a faulty disk or copy."""
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 0x10
    file.write_bytes(data)


def cut(file):
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 3])


def empty(file):
    file.write_bytes(b"")


@pytest.mark.parametrize("damage", [flip_bits, cut, empty])
@pytest.mark.parametrize("name", ["geo.usdc", "rig.usdc"])
@pytest.mark.parametrize("opened", [load_rig, describe, validate_stage])
def test_damage_is_found(opened, name, damage, anchored_folder):
    damage(anchored_folder / name)
    with pytest.raises(RigError, match=f"{name}: is damaged"):
        opened(anchored_folder / "actor.usda")


def test_every_single_byte_counts(anchored_folder):
    file = anchored_folder / "geo.usdc"
    whole = file.read_bytes()
    for place in np.linspace(0, len(whole) - 1, 41).astype(int):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        with pytest.raises(RigError, match="is damaged"):
            describe(anchored_folder / "actor.usda")


@pytest.mark.parametrize("command", ["validate", "info"])
@pytest.mark.parametrize("checksums", [True, False])
def test_commands_say_so_in_one_line(command, checksums, anchored_folder):
    if not checksums:
        forget_checksums(anchored_folder)
    cut(anchored_folder / "geo.usdc")
    line = [sys.executable, "-m", "jawusd", command, str(anchored_folder / "actor.usda")]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    assert done.returncode == RigError.exit_code
    assert "geo.usdc" in done.stderr and "Traceback" not in done.stderr and "crateFile.cpp" not in done.stderr


def test_damage_is_found_through_what_uses_the_rig(anchored_folder, tmp_path):
    anim = write_animation(tmp_path / "anim.usda", anchored_folder / "actor.usda", [1, 2], np.zeros((2, 3)), FPS)
    flip_bits(anchored_folder / "geo.usdc")
    with pytest.raises(RigError, match="geo.usdc: is damaged"):
        describe(anim)


def test_rigs_without_checksums_and_without_meshes_are_read(anchored_folder):
    forget_checksums(anchored_folder)
    assert load_rig(anchored_folder / "actor.usda")


def test_rigs_whose_meshes_stayed_behind_are_read(anchored_folder):
    (anchored_folder / "geo.usdc").unlink()
    assert load_rig(anchored_folder / "actor.usda")


def test_published_rigs_have_checksums_of_their_own(anchored_folder, tmp_path):
    publish_rig(anchored_folder, tmp_path / "out", "hero")
    assert_valid_usd(tmp_path / "out" / "hero.usda")
    assert_valid_usd(tmp_path / "out" / "hero.usdz")
    flip_bits(tmp_path / "out" / "hero_geo.usdc")
    with pytest.raises(RigError, match="hero_geo.usdc: is damaged"):
        load_rig(tmp_path / "out" / "hero.usda")


@pytest.mark.parametrize("value", ["x", {"../actor.usda": "x"}, {"geo.usdc": 5.0}, {"/dev/zero": "x"}])
def test_checksums_of_other_kinds_open_no_other_files(value, anchored_folder):
    layer = Sdf.Layer.OpenAsAnonymous(str(anchored_folder / "actor.usda"))
    layer.customLayerData = {CHECKSUMS: value}
    layer.Export(str(anchored_folder / "actor.usda"))
    try:
        describe(anchored_folder / "actor.usda")
    except RigError as error:
        assert "geo.usdc: is damaged" in str(error)

"""A few attacks of `attacks.py`, which runs all of them and prints what held."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
import attacks

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits of Linux")


@pytest.mark.parametrize("name", ["40,000 prims deep, info", "folder not UTF-8", "archive cut off", "ulimit -v 300 MB"])
def test_attacks_are_held_off(name, tmp_path):
    held, line = attacks.run(attacks.ATTACKS[name], tmp_path)
    assert held, line


@pytest.mark.parametrize("wrong", [{"code": 0}, {"says": "nothing of the kind"}, {"most_mb": 1}])
def test_an_attack_that_succeeds_is_seen(wrong, tmp_path):
    from dataclasses import replace

    assert not attacks.run(replace(attacks.ATTACKS["archive cut off"], **wrong), tmp_path)[0]

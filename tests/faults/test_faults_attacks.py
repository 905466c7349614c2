"""The attacks of `attacks.py` are all held off."""

import os
import sys
from dataclasses import replace
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
import attacks

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits of Linux")
QUICK = ("40,000 prims deep, info", "folder not UTF-8", "emoji, ASCII names", "archive cut off", "ulimit -v 300 MB")
ALL = [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in attacks.ATTACKS]


@pytest.mark.parametrize("name", ALL)
def test_attacks_are_held_off(name, tmp_path):
    if name == "no /proc" and os.geteuid():
        pytest.skip("needs root")
    held, line = attacks.run(attacks.ATTACKS[name], tmp_path)
    assert held, line


@pytest.mark.parametrize("wrong", [{"code": 0}, {"says": "nothing of the kind"}, {"most_mb": 1}])
def test_an_attack_that_succeeds_is_seen(wrong, tmp_path):
    assert not attacks.run(replace(attacks.ATTACKS["archive cut off"], **wrong), tmp_path)[0]

"""Tooth contacts on a page: drawn on request, explained if missing."""

import numpy as np
import pytest
from example_rig import FPS, example_meshes, example_rig, touching_rig
from quiet_page import QuietPage

from jawusd.pipeline.view import viewed_actor
from jawusd.rig.bake import bake_rig
from jawusd.viewer.server import Viewer


def page_of(folder, rig):
    bake_rig(folder, rig, example_meshes(), name="someone", fps=FPS, table_size=17)
    actor = viewed_actor(folder)
    running = Viewer(lambda: actor, "127.0.0.1", 0)
    return actor, running, QuietPage(running)


@pytest.fixture
def marked(tmp_path, monkeypatch):
    """Return a page whose contact pictures encode their pose."""
    drawn = []

    def draw(self, d):
        drawn.append(tuple(d))
        return np.full((6, 9, 3), 7, np.uint8)

    monkeypatch.setattr("jawusd.pipeline.view.ContactView.draw", draw)
    _, running, quiet = page_of(tmp_path, touching_rig())
    yield quiet, drawn
    running.stop()


def test_pictures_are_drawn_only_while_they_are_shown(marked):
    quiet, drawn = marked
    panel = quiet.page.contacts
    quiet.enter(quiet.page.pose.sliders[0], 5.0)
    assert not drawn and not panel.picture.visible
    quiet.enter(panel.shown, True)
    assert drawn == [quiet.page.session.work.d]
    assert panel.picture.visible and panel.picture.image.shape == (6, 9, 3)
    assert "clearance" in panel.text.content and "touching" in panel.text.content
    quiet.enter(quiet.page.pose.sliders[0], 6.0)
    assert len(drawn) == 2 and drawn[1][0] == 6.0
    quiet.enter(panel.shown, False)
    quiet.enter(quiet.page.pose.sliders[0], 7.0)
    assert len(drawn) == 2 and not panel.picture.visible


def test_a_rig_without_contact_says_so(tmp_path):
    actor, running, quiet = page_of(tmp_path, example_rig())
    try:
        assert actor.contacts is None and quiet.page.contacts is None
    finally:
        running.stop()


def test_meshes_that_do_not_meet_give_a_message_and_no_traceback(tmp_path):
    # the example's teeth are coarse balls
    _, running, quiet = page_of(tmp_path, touching_rig())
    try:
        quiet.enter(quiet.page.contacts.shown, True)
        assert "does not allow tooth contact to be computed" in quiet.page.contacts.text.content
    finally:
        running.stop()

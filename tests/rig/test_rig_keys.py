"""Times and values of attributes: samples, splines, and their priority if layers have both."""

import pytest
from pxr import Sdf, Ts, Usd

from jawusd.rig.attributes import key_and_frame_times, key_times, values_at


@pytest.fixture
def stage():
    """Return a stage whose weaker layer has a spline from 0 to 8 over frames 1 to 5, and that layer."""
    weak = Sdf.Layer.CreateAnonymous(".usda")
    below = Usd.Stage.Open(weak)
    attribute = below.DefinePrim("/A").CreateAttribute("x", Sdf.ValueTypeNames.Double)
    spline = Ts.Spline("double")
    for time, value in ((1.0, 0.0), (4.5, 7.0), (5.0, 8.0)):
        spline.SetKnot(Ts.Knot("double", time=time, value=value, nextInterp=Ts.InterpLinear))
    attribute.SetSpline(spline)
    made = Usd.Stage.CreateInMemory()
    made.GetRootLayer().subLayerPaths.append(weak.identifier)
    return made, weak


def test_splines_have_their_knots_and_the_whole_frames_between(stage):
    attribute = stage[0].GetAttributeAtPath("/A.x")
    assert key_times(attribute) == [1, 2, 3, 4, 4.5, 5]
    assert values_at(attribute, [2, 4.5]) == [2, 7]
    times, keyed = key_and_frame_times([attribute])
    assert times.tolist() == [1, 2, 3, 4, 4.5, 5] and keyed.all()


def test_samples_above_a_spline_count(stage):
    attribute = stage[0].GetAttributeAtPath("/A.x")
    attribute.Set(3.0, 2.0)
    attribute.Set(5.0, 4.0)
    assert key_times(attribute) == [2, 4] and values_at(attribute, [3]) == [4]


def test_a_value_above_a_spline_counts(stage):
    attribute = stage[0].GetAttributeAtPath("/A.x")
    attribute.Set(3.0)
    assert key_times(attribute) == [] and values_at(attribute, [2]) == [3]


def test_splines_of_referenced_layers_come_in_the_time_of_the_stage(stage):
    shot = Usd.Stage.CreateInMemory()
    reference = Sdf.Reference(stage[1].identifier, "/A", Sdf.LayerOffset(100))
    shot.DefinePrim("/B").GetReferences().AddReference(reference)
    attribute = shot.GetAttributeAtPath("/B.x")
    assert key_times(attribute)[0] == 101 and values_at(attribute, [103]) == [4]

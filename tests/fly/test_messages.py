"""Messages of ROS 2 that are made of the flight log."""

from __future__ import annotations

import numpy as np
import pytest

from mjxfly.messages import FIELDS, _moving

OURS = "mjxball_msgs"


def test_the_types_are_those_of_ros() -> None:
    """As `rosbags` has them, field by field and in their order."""
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for name, text in FIELDS.items():
        if name.startswith(OURS):
            continue
        wanted = typesys.get_types_from_msg(text, name.replace("/", "/msg/"))
        for kind, (_, fields) in wanted.items():
            assert fields == store.fielddefs[kind][1], kind


def test_a_twist_is_in_the_axes_of_its_frame() -> None:
    """A drone that turned by 90 degrees to the left and moves along x of the world moves to its own right."""
    left = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
    (twist,) = (
        one
        for topic, one in _moving("leader", np.zeros(3), left, np.array([1.0, 0, 0]), np.zeros(3), 0)
        if "twist" in topic
    )
    along = twist["twist"]["linear"]
    np.testing.assert_allclose([along["x"], along["y"], along["z"]], [0.0, -1.0, 0.0], atol=1e-12)

"""The records of a scene: what cannot work is refused when they are made, and what is made stays as it is."""

from dataclasses import replace

import numpy as np
import pytest

import warp_ir as ir

POINTS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
TRIANGLES = np.array([[0, 1, 2]], np.int32)


def mesh(**changes):
    return ir.Mesh(
        **{"name": "/card", "points": POINTS, "triangles": TRIANGLES, "material": np.zeros(1, int)} | changes
    )


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: mesh(points=POINTS.tolist()), "mesh '/card': points must be a NumPy array, is of type list"),
        (lambda: mesh(normals=((0, 0, 1),)), "mesh '/card': normals must be a NumPy array"),
        (lambda: ir.Instances("/pine", (0,), [np.eye(4)]), "instances '/pine': matrices must be a NumPy array"),
        (lambda: ir.Light("/sun", ir.LightKind.DISTANT, (1, 1, 1), [[1]]), "light '/sun': world_from_light must be"),
        (lambda: ir.Texture("a.png", [[1.0]]), "texture 'a.png': pixels must be"),
        (lambda: ir.Camera("/eye", [[1.0]]), "camera '/eye': world_from_camera must be"),
    ],
)
def test_a_list_is_no_array(make, message):
    """The message names the record and the field."""
    with pytest.raises(ir.InputError, match=message.replace("(", "\\(")):
        make()


def test_a_record_cannot_be_edited_in_place():
    """Writing to the array of a record is an error, since nothing would see it; `replace` makes a changed record."""
    card = mesh()
    with pytest.raises(ValueError, match="read-only"):
        card.points[0] = 5.0
    POINTS[0] = 0.0  # whoever made the array may go on using it
    moved = replace(card, points=card.points + 1.0)
    np.testing.assert_array_equal(moved.points, POINTS + 1.0)
    assert moved.triangles is card.triangles

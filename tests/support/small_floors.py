"""Small maps drawn of rectangles, for tests of what is done with maps."""

import numpy as np
from scipy import ndimage

from fog_contracts.costs import FREE, LETHAL, UNKNOWN
from fog_contracts.grid import GridGeometry, StaticMap

Box = tuple[float, float, float, float]


def floor(*free: Box, boxes: tuple[Box, ...] = ()) -> StaticMap:
    """Return a map of 15 x 10 m with free rectangles (left, bottom, right, top; m), boxes in them, walls of 0.2 m."""
    open_ = np.zeros((200, 300), bool)
    for rectangles, value in ((free, True), (boxes, False)):
        for left, bottom, right, top in rectangles:
            open_[round(bottom * 20) : round(top * 20), round(left * 20) : round(right * 20)] = value
    near = ndimage.binary_dilation(open_, np.ones((9, 9), bool))
    cells = np.where(open_, FREE, np.where(near, LETHAL, UNKNOWN)).astype(np.uint8)
    return StaticMap(GridGeometry(300, 200, 0.05, 0.0, 0.0), cells)


ROOMS: tuple[Box, ...] = (
    (1, 1, 14, 3), (1, 1, 3, 9), (4, 3.2, 7, 6), (5, 2.8, 6, 3.4), (8, 4, 13, 9), (9, 2.8, 10, 4.2),
)  # fmt: skip
OFFICE = floor(*ROOMS)

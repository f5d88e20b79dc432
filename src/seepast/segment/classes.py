"""Which numbers a network gives to which classes, and which of them were asked for.

The tables are those of the data sets that public networks are trained on, in the order of the networks' outputs:
COCO (80 classes, the 91 category numbers with their gaps, or 81 with the background first), Pascal VOC (21),
Cityscapes (19 training classes) and ADE20K (150).
"""

from __future__ import annotations

import ast
import difflib
from collections.abc import Mapping, Sequence

from ..errors import OptionsError

Names = Mapping[int, str]  # number of the class in the network's output -> its name, in lower case

PEOPLE = ("person",)  # what is taken for dynamic when nobody says otherwise


def _names(text: str, first: int = 0) -> dict[int, str]:
    return dict(enumerate((name.strip() for name in text.split(",")), first))


COCO = _names(
    "person, bicycle, car, motorcycle, airplane, bus, train, truck, boat, traffic light, fire hydrant, stop sign, "
    "parking meter, bench, bird, cat, dog, horse, sheep, cow, elephant, bear, zebra, giraffe, backpack, umbrella, "
    "handbag, tie, suitcase, frisbee, skis, snowboard, sports ball, kite, baseball bat, baseball glove, "
    "skateboard, surfboard, tennis racket, bottle, wine glass, cup, fork, knife, spoon, bowl, banana, apple, "
    "sandwich, orange, broccoli, carrot, hot dog, pizza, donut, cake, chair, couch, potted plant, bed, "
    "dining table, toilet, tv, laptop, mouse, remote, keyboard, cell phone, microwave, oven, toaster, sink, "
    "refrigerator, book, clock, vase, scissors, teddy bear, hair drier, toothbrush"
)
COCO_AFTER_BACKGROUND = {0: "background", **{i + 1: name for i, name in COCO.items()}}
_COCO_GAPS = (12, 26, 29, 30, 45, 66, 68, 69, 71, 83)  # category numbers of COCO's paper that have no data
COCO_CATEGORIES = {
    0: "background",
    **dict(zip((i for i in range(1, 91) if i not in _COCO_GAPS), COCO.values(), strict=True)),
}
VOC = _names(
    "background, aeroplane, bicycle, bird, boat, bottle, bus, car, cat, chair, cow, dining table, dog, horse, "
    "motorbike, person, potted plant, sheep, sofa, train, tv monitor"
)
CITYSCAPES = _names(
    "road, sidewalk, building, wall, fence, pole, traffic light, traffic sign, vegetation, terrain, sky, person, "
    "rider, car, truck, bus, train, motorcycle, bicycle"
)
ADE = _names(
    "wall, building, sky, floor, tree, ceiling, road, bed, windowpane, grass, cabinet, sidewalk, person, earth, "
    "door, table, mountain, plant, curtain, chair, car, water, painting, sofa, shelf, house, sea, mirror, rug, "
    "field, armchair, seat, fence, desk, rock, wardrobe, lamp, bathtub, railing, cushion, base, box, column, "
    "signboard, chest of drawers, counter, sand, sink, skyscraper, fireplace, refrigerator, grandstand, path, "
    "stairs, runway, case, pool table, pillow, screen door, stairway, river, bridge, bookcase, blind, "
    "coffee table, toilet, flower, book, hill, bench, countertop, stove, palm, kitchen island, computer, "
    "swivel chair, boat, bar, arcade machine, hovel, bus, towel, light, truck, tower, chandelier, awning, "
    "streetlight, booth, television receiver, airplane, dirt track, apparel, pole, land, bannister, escalator, "
    "ottoman, bottle, buffet, poster, stage, van, ship, fountain, conveyer belt, canopy, washer, plaything, "
    "swimming pool, stool, barrel, basket, waterfall, tent, bag, minibike, cradle, oven, ball, food, step, tank, "
    "trade name, microwave, pot, animal, bicycle, lake, dishwasher, screen, blanket, sculpture, hood, sconce, "
    "vase, traffic light, tray, ashcan, fan, pier, crt screen, plate, monitor, bulletin board, shower, radiator, "
    "glass, clock, flag"
)
BY_COUNT: Mapping[int, Names] = {
    19: CITYSCAPES, 21: VOC, 80: COCO, 81: COCO_AFTER_BACKGROUND, 91: COCO_CATEGORIES, 150: ADE
}  # fmt: skip


def names_in_model(metadata: Mapping[str, str]) -> Names | None:
    """The class names that exporters of YOLO networks leave in the model's metadata, None where there are none."""
    try:
        names = ast.literal_eval(metadata["names"])
    except (KeyError, ValueError, SyntaxError):
        return None
    if isinstance(names, (list, tuple)):
        names = dict(enumerate(names))
    if not isinstance(names, dict) or not all(isinstance(number, int) for number in names):
        return None
    if all(str(name) == str(number) for number, name in names.items()):  # what stands there before anybody fills it in
        return None
    return {number: str(name).lower() for number, name in names.items()}


def class_numbers(wanted: Sequence[str], names: Names | None, count: int | None = None) -> tuple[int, ...]:
    """The numbers of the classes that are `wanted`, by name or by number, sorted.

    names: those that the network knows, None where nobody knows them; count: how many classes it has, if known.
    Raises OptionsError for a name or number that the network does not have.
    """
    return tuple(sorted({_class_number(word, names, count) for word in wanted}))


def _class_number(word: str, names: Names | None, count: int | None) -> int:
    word = " ".join(word.lower().replace("_", " ").split())
    if word.isdigit():
        number = int(word)
        if (count is not None and number >= count) or (count is None and names and number > max(names)):
            last = (count or max(names or (0,)) + 1) - 1
            raise OptionsError(f"--classes {word}: the network's classes are numbered 0 to {last}; choose from these")
        return number
    if names is None:
        known = "" if count is None else f"; the network has {count} classes, numbered 0 to {count - 1}"
        raise OptionsError(
            f"--classes {word}: nothing says what this network's classes are called: give their numbers{known}"
        )
    for number, name in names.items():
        if name == word:
            return number
    near = difflib.get_close_matches(word, names.values(), 3) or [*sorted(names.values())[:12], "..."]
    raise OptionsError(f"--classes {word}: the network has no such class; it has {', '.join(near)}")

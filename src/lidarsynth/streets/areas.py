"""Kinds of surroundings, as KITTI drives through them: how wide, how dense, what stands where."""

from __future__ import annotations

from dataclasses import dataclass, replace

from lidarsynth.streets.ground import KERB

Range = tuple[float, float]


@dataclass(frozen=True)
class Area:
    """One kind of street. Ranges are uniform; `per_100` counts things per 100 m and side; shares are probabilities."""

    weight: float  # how often the kind is drawn
    half: Range  # m, half width of the driving lanes
    walk: Range  # m, sidewalk width
    parking: tuple[float, float]  # share of streets with a parking lane on the right, on the left
    parked: Range  # share of its length that is taken
    setback: Range  # m from the sidewalk to the fronts
    house: Range  # m, length of a front
    gap: Range  # m between houses
    vacant: float  # share of lots without a house
    shops: float  # share of fronts with a glazed ground floor
    borders: tuple[float, float, float, float]  # shares of lots bordered by wall, hedge, fence, nothing
    trees: Range  # per 100 m and side, in a row by the kerb
    garden: Range  # bushes and small trees per 100 m and side, between sidewalk and fronts
    thicket: Range  # big vegetation per 100 m and side, behind
    lamps: float  # per 100 m and side
    signs: float
    people: Range  # per 100 m and side
    bicycles: Range  # parked ones
    traffic: Range  # moving vehicles per 100 m and lane
    crossings: tuple[int, int]  # how many side roads within 300 m
    lanes: tuple[float, float]  # share of dashed, of solid centre lines
    bend: Range  # m, amplitude of the road's waves
    slope: float  # standard deviation of the gradient
    verge: tuple[str, ...]  # material words between sidewalk and fronts
    closed: float = 0.5  # how far houses close the view: share of road ends, and density of those behind
    rails: float = 0.0  # share of streets with a tram
    bank: float = 0.0  # standard deviation of the slope beside the road
    kerb_bushes: float = 0.6  # per 100 m and side
    on_road: float = 1.5  # pedestrians on the main road
    woods: float = 1.0  # size of those that close a view
    groups: float = 0.0  # of people who stand together, per 100 m and side; these twelve only where asked for
    motorcycles: float = 0.0
    works: float = 0.0
    cyclists: float = 0.0
    heavy: float = 0.0
    walls: float = 0.0
    barriers: float = 0.0
    panels: float = 0.0
    garages: float = 0.0
    riders: float = 0.0
    walkers: float = 0.0
    racks: float = 0.0
    kerb: float = KERB  # m, from carriageway to sidewalk
    car_parks: bool = True  # and parked bicycles; False leaves them out, and all else where it is


# fmt: off
HIGHEST = 3  # times 12 cm, of kerbs

AREAS: dict[str, Area] = {
    "city": Area(
        weight=0.21, half=(3.0, 6.5), walk=(2.0, 5.5), parking=(0.7, 0.6), parked=(0.3, 0.85), setback=(0.0, 3.0),
        house=(8, 24), gap=(0, 2), vacant=0.10, shops=0.45, borders=(0.1, 0.15, 0.1, 0.65), trees=(0, 8), garden=(0, 4),
        thicket=(0, 2), lamps=3.0, signs=9.0, people=(1, 9), bicycles=(0, 6), traffic=(0.5, 3.5), crossings=(1, 3),
        lanes=(0.35, 0.1), bend=(0, 9), slope=0.015, verge=("sidewalk",), closed=0.6, rails=0.15),
    "old town": Area(
        weight=0.08, half=(1.9, 2.8), walk=(1.0, 2.5), parking=(0.35, 0.2), parked=(0.3, 0.8), setback=(0.0, 0.6),
        house=(6, 15), gap=(0, 0.5), vacant=0.07, shops=0.35, borders=(0.3, 0.2, 0.2, 0.3), trees=(0, 3), garden=(0, 4),
        thicket=(0, 2), lamps=3.0, signs=6.0, people=(0, 7), bicycles=(0, 5), traffic=(0, 1), crossings=(1, 3),
        lanes=(0.0, 0.0), bend=(0, 10), slope=0.02, verge=("sidewalk", "gravel"), closed=0.8),
    "residential": Area(
        weight=0.38, half=(2.4, 3.3), walk=(1.3, 3.5), parking=(0.5, 0.4), parked=(0.2, 0.8), setback=(2.0, 11.0),
        house=(9, 17), gap=(2, 12), vacant=0.15, shops=0.02, borders=(0.17, 0.55, 0.18, 0.1), trees=(0, 6),
        garden=(6, 24), thicket=(2, 12), lamps=2.5, signs=4.0, people=(0, 2), bicycles=(0, 1), traffic=(0, 1),
        crossings=(1, 3), lanes=(0.1, 0.0), bend=(0, 10), slope=0.03, verge=("grass", "grass", "gravel"),
        closed=0.5, bank=0.07),
    "avenue": Area(
        weight=0.13, half=(5.5, 9.0), walk=(1.5, 4.0), parking=(0.2, 0.2), parked=(0.2, 0.7), setback=(4.0, 18.0),
        house=(15, 45), gap=(3, 25), vacant=0.35, shops=0.15, borders=(0.1, 0.35, 0.15, 0.4), trees=(0, 10),
        garden=(3, 16), thicket=(2, 14), lamps=3.5, signs=9.0, people=(0, 3), bicycles=(0, 2), traffic=(1.0, 4.0),
        crossings=(0, 2), lanes=(0.7, 0.2), bend=(0, 4), slope=0.01, verge=("grass", "sidewalk"), closed=0.5,
        rails=0.2, bank=0.04),
    "country": Area(
        weight=0.11, half=(2.8, 4.0), walk=(0.0, 0.0), parking=(0.0, 0.0), parked=(0, 0), setback=(8.0, 30.0),
        house=(10, 30), gap=(20, 80), vacant=0.6, shops=0.0, borders=(0.02, 0.3, 0.2, 0.48), trees=(0, 6),
        garden=(4, 20), thicket=(6, 30), lamps=0.5, signs=3.0, people=(0, 0.3), bicycles=(0, 0), traffic=(0.2, 2),
        crossings=(0, 1), lanes=(0.6, 0.2), bend=(0, 12), slope=0.025, verge=("grass",), closed=0.25, bank=0.11),
    "campus": Area(
        weight=0.09, half=(2.4, 4.0), walk=(1.5, 4.0), parking=(0.5, 0.3), parked=(0.3, 0.8), setback=(5.0, 22.0),
        house=(15, 50), gap=(5, 25), vacant=0.2, shops=0.3, borders=(0.08, 0.4, 0.1, 0.42), trees=(1, 9),
        garden=(4, 18), thicket=(1, 8), lamps=3.0, signs=3.0, people=(1, 8), bicycles=(0, 12), traffic=(0, 1),
        crossings=(1, 3), lanes=(0.1, 0.0), bend=(0, 5), slope=0.012, verge=("grass", "sidewalk"), closed=0.7,
        bank=0.03),
}
# fmt: on


@dataclass(frozen=True)
class Density:
    """How much of what there is, as factors of what the kind of street has; 1 leaves a world as it is.

    parking  of vehicles along the street; 0 leaves out car parks and bicycles too, which are as many for any other
    kerbs    factor of their height of 12 cm

    More, per 100 m and side: groups of people, parked motorcycles, road works, cyclists beside the road; heavy vehicles
    that stand (lorries, coaches, trailers); walls and fences of more kinds; crash barriers; panels larger than signs;
    garages; on the main road riders, of bicycles and motorcycles; people on sidewalks, racks of bicycles, and these
    riders, of more shapes than every street has.

    Raises ValueError for a factor outside 0 to 100, of kerbs outside 0 to HIGHEST.
    """

    traffic: float = 1.0  # moving vehicles and cyclists
    parking: float = 1.0  # parked vehicles
    pedestrians: float = 1.0
    vegetation: float = 1.0  # trees, bushes, thickets
    groups: float = 0.0
    motorcycles: float = 0.0
    works: float = 0.0
    kerbs: float = 1.0
    cyclists: float = 0.0
    heavy: float = 0.0
    walls: float = 0.0
    barriers: float = 0.0
    panels: float = 0.0
    garages: float = 0.0
    riders: float = 0.0
    walkers: float = 0.0
    racks: float = 0.0

    def __post_init__(self):
        for name, factor in vars(self).items():
            if not 0 <= factor <= 100:
                raise ValueError(f"expected {name} of 0 to 100, found {factor}")
        if self.kerbs > HIGHEST:
            raise ValueError(f"expected kerbs of at most {HIGHEST} times 12 cm, found {self.kerbs}")

    def of(self, area: Area) -> Area:
        """The kind of street with these factors."""
        if self == TODAY:
            return area
        times = {"traffic": ("traffic",), "pedestrians": ("people",), "vegetation": ("trees", "garden", "thicket")}
        new = {f: _scaled(getattr(area, f), getattr(self, word)) for word, fields in times.items() for f in fields}
        low, high = _scaled(area.parked, self.parking)
        new["parked"] = (min(low, 1.0), min(high, 1.0))
        green = {"kerb_bushes": area.kerb_bushes * self.vegetation, "woods": area.woods * self.vegetation}
        new |= {name: getattr(self, name) for name in MORE}
        green["on_road"], green["kerb"] = area.on_road * self.pedestrians, area.kerb * self.kerbs
        return replace(area, **new, **green, car_parks=self.parking > 0)


MORE = ("groups", "motorcycles", "works", "cyclists", "heavy", "walls", "barriers", "panels", "garages",
        "riders", "walkers", "racks")  # fmt: skip


def _scaled(bounds: Range, factor: float) -> Range:
    return bounds[0] * factor, bounds[1] * factor


TODAY = Density()

"""Paint and light: markings, openings, snow, lamps where they belong."""

from dataclasses import replace

import numpy as np
import pytest

from fprf.town.layout import CROSSING, KERB, ROAD_HALF, build_town
from fprf.town.paint import foliage_normals, paint, paint_ground, paint_walls
from fprf.town.palettes import PALETTES, palette
from fprf.town.render import shade
from fprf.town.shapes import (
    PLINTH,
    STOREY,
    Cylinder,
    Ellipsoid,
    Finish,
    Lot,
    Material,
    Polyhedron,
    box,
    bush,
    car,
    church,
    cylinder,
    ellipsoid,
    extrude,
    forest,
    house,
    lamp,
    tree,
)
from fprf.town.surface import facade_parts, on_face

DAY = palette("day")
TOWN = build_town(0)
GREY = Finish(Material.TRIM)


def strip(x, y):
    x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def fronts():
    return np.flatnonzero((TOWN.faces.material == Material.FACADE) & (TOWN.faces.door >= 0))


def on_wall(face, u, v):
    faces = TOWN.faces
    return faces.origin[face] + u[:, None] * faces.u[face] + v[:, None] * faces.v[face]


def test_the_middle_line_is_dashed_and_the_edge_line_whole():
    x = np.arange(20, 32, 0.05)
    middle = paint_ground(strip(x, 0.0), DAY).mean(1)
    assert 0.4 < (middle > 0.6).mean() < 0.7
    assert np.abs(np.diff(middle > 0.6)).sum() == 2 * 3, "three dashes in twelve metres"
    assert (paint_ground(strip(x, ROAD_HALF - 0.3), DAY).mean(1) > 0.6).all()
    assert (paint_ground(strip(x, 1.7), DAY).mean(1) < 0.5).all()


def test_the_crossing_has_stripes():
    y = np.arange(-3, 3, 0.02)
    bright = paint_ground(strip(CROSSING + 1.5, y), DAY).mean(1) > 0.6
    assert np.abs(np.diff(bright)).sum() == 12
    assert not (paint_ground(strip(CROSSING - 0.5, y), DAY).mean(1) > 0.6).any()


def test_the_kerb_is_lighter_than_the_slabs():
    x = np.linspace(0, 30, 200)
    kerb = paint_ground(strip(x, ROAD_HALF + KERB / 2), DAY).mean()
    assert kerb > paint_ground(strip(x, ROAD_HALF + 1.0), DAY).mean() + 0.03


def test_snow_and_leaves_lie_most_on_the_lawn():
    rng = np.random.default_rng(0)
    x = rng.uniform(0, 40, 3000)
    for name in ("winter", "autumn"):
        look = PALETTES[name]
        bare = replace(look, snowing=0.0, littering=0.0)
        changed = [
            np.abs(paint_ground(strip(x, y), look) - paint_ground(strip(x, y), bare)).mean()
            for y in (7.0, ROAD_HALF + 1.0, 1.8)
        ]
        assert changed[0] > 0.05
        assert changed[0] > changed[2]
        assert changed[1] > changed[2]


def test_coordinates_on_walls_are_those_of_the_frame():
    rng = np.random.default_rng(1)
    for face in fronts()[:4]:
        u, v = rng.uniform(0, 1, (2, 50)) * TOWN.faces.extent[face][:, None]
        a, b = on_face(TOWN.faces, np.full(50, face), on_wall(face, u, v))
        np.testing.assert_allclose(np.stack([a, b]), np.stack([u, v]), atol=1e-9)


def test_only_glass_glows_and_only_when_lit():
    for name, share in (("day", 0.0), ("night", PALETTES["night"].lit)):
        glowing = holes = 0
        for face in fronts():
            wide, high = TOWN.faces.extent[face]
            u, v = (c.ravel() for c in np.meshgrid(np.arange(0.03, wide, 0.06), np.arange(0.03, high, 0.06)))
            at = np.full(len(u), face)
            colour, glow = paint_walls(TOWN.faces, at, on_wall(face, u, v), PALETTES[name])
            parts = facade_parts(TOWN.faces, at, u, v)
            assert not glow[~parts.window].any()
            assert (glow >= 0).all()
            assert np.isfinite(colour).all()
            for hole in set(zip(parts.column[parts.window], parts.storey[parts.window], strict=True)):
                inside = parts.window & (parts.column == hole[0]) & (parts.storey == hole[1])
                glowing += bool(glow[inside].max() > 0.05)
                holes += 1
        assert glowing / holes == pytest.approx(share, abs=0.2)


def test_frames_are_brighter_than_panes():
    face = fronts()[0]
    wide, high = TOWN.faces.extent[face]
    u, v = (c.ravel() for c in np.meshgrid(np.arange(0.01, wide, 0.02), np.arange(0.01, high, 0.02)))
    at = np.full(len(u), face)
    colour, _ = paint_walls(TOWN.faces, at, on_wall(face, u, v), DAY)
    parts = facade_parts(TOWN.faces, at, u, v)
    frame = parts.window & (parts.half - np.abs(parts.across) < 0.05)
    pane = parts.window & (np.abs(np.abs(parts.across) - 0.2) < 0.05) & (np.abs(parts.up - 0.3 * parts.tall) < 0.1)
    assert colour[frame].mean() > colour[pane].mean() + 0.2


def test_leaves_bend_normals_but_keep_them_units():
    rng = np.random.default_rng(2)
    points = rng.uniform(-5, 5, (200, 3))
    normals = np.tile(np.array([0, 0, 1], np.float32), (200, 1))
    bent = foliage_normals(points, normals, np.zeros(200, bool))
    np.testing.assert_allclose(np.linalg.norm(bent, axis=1), 1, rtol=1e-5)
    assert 0.5 < bent[:, 2].mean() < 0.99
    np.testing.assert_array_equal(bent[:20], foliage_normals(points[:20], normals[:20], np.zeros(20, bool)))


@pytest.mark.parametrize("name", PALETTES)
def test_every_face_can_be_painted(name):
    faces = np.arange(len(TOWN.faces.material))
    points = TOWN.faces.origin + 0.5 * (TOWN.faces.extent[:, :1] * TOWN.faces.u + TOWN.faces.extent[:, 1:] * TOWN.faces.v)
    normals = np.cross(TOWN.faces.u, TOWN.faces.v).astype(np.float32)
    colour, glow = paint(TOWN, faces, points, normals, PALETTES[name])
    assert colour.dtype == glow.dtype == np.float32
    assert ((colour >= 0) & (colour <= 1)).all()
    assert np.isfinite(glow).all()


def test_lamps_light_the_ground_below_them():
    x, y, _ = TOWN.lamps[2]
    away = np.linspace(0.5, 12, 30)
    points = strip(x, y - np.sign(y) * away)
    dark = replace(PALETTES["night"], lamps=0.0)
    gain = (shade(TOWN, PALETTES["night"], np.zeros(30, int), points) - shade(TOWN, dark, np.zeros(30, int), points)).mean(1)
    assert gain[0] > 0.1
    assert (gain >= -1e-6).all()
    assert gain[0] > gain[10]


def test_faces_of_a_box_look_outward():
    solid = box((1, 2, 0), (4, 4, 3), [GREY] * 6)
    expected = [(0, -1, 0), (1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, 0, -1), (0, 0, 1)]
    np.testing.assert_allclose(solid.normals, expected, atol=1e-12)
    for face, normal in zip(solid.faces, solid.normals, strict=True):
        np.testing.assert_allclose(np.cross(face.u, face.v), normal, atol=1e-12)
    assert [tuple(face.extent) for face in solid.faces] == [(3, 3), (2, 3), (3, 3), (2, 3), (3, 2), (3, 2)]
    assert (solid.low.tolist(), solid.high.tolist()) == ([1, 2, 0], [4, 4, 3])


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_swept_corners_lie_on_the_solid(axis):
    profile = [(0.0, 0.0), (2.0, 0.0), (1.5, 1.0), (0.3, 1.2)]
    solid = extrude(profile, axis, -1.0, 2.0, [GREY] * 6)
    across = [i for i in range(3) if i != axis]
    for corner in profile:
        for along in (-1.0, 2.0):
            point = np.zeros(3)
            point[across], point[axis] = corner, along
            room = solid.offsets - solid.normals @ point
            assert room.min() > -1e-9
            assert (np.abs(room) < 1e-9).sum() == 3, "three faces meet in a corner"


def test_round_solids_know_their_normals():
    for solid in (ellipsoid((1, 2, 3), (1, 2, 0.5), GREY), cylinder(1, 2, 0, 3, 0.5, GREY)):
        (face,) = solid.faces
        assert isinstance(solid, Ellipsoid | Cylinder)
        np.testing.assert_allclose(face.centre, (solid.low + solid.high) / 2)
        assert (face.curve[:2] > 0).all()
    assert face.curve[2] == 0, "the side of a post is upright"


@pytest.mark.parametrize("style", range(4))
@pytest.mark.parametrize("side", [-1, 1])
def test_houses_stand_on_their_lot(style, side):
    for seed in range(6):
        lot = Lot(3.0, 11.0, 8.0, 7.5, side)
        shapes = house(lot, style, np.random.default_rng(seed))
        body = shapes[0]
        assert isinstance(body, Polyhedron)
        assert (body.low[0], body.high[0], body.low[2]) == (3.0, 11.0, 0.0)
        assert sorted(np.abs([body.low[1], body.high[1]])) == [8.0, 15.5]
        assert ((body.high[2] - PLINTH) / STOREY) == pytest.approx(round((body.high[2] - PLINTH) / STOREY))
        doors = [face for face in body.faces if face.finish.door >= 0]
        assert len(doors) == 1
        assert np.cross(doors[0].u, doors[0].v)[1] == pytest.approx(-side), "the door looks at the street"
        for shape in shapes[1:]:
            assert (shape.low[:2] >= body.low[:2] - 0.5).all()
            assert (shape.high[:2] <= body.high[:2] + 0.5).all()


def test_what_lines_the_street_is_of_its_size():
    rng = np.random.default_rng(0)
    for axis in (0, 1):
        parts = car(10.0, 2.0, axis, rng)
        size = np.max([p.high for p in parts], 0) - np.min([p.low for p in parts], 0)
        assert size[axis] == pytest.approx(4.2, abs=0.05)
        assert size[1 - axis] == pytest.approx(1.8, abs=0.1)
        assert size[2] == pytest.approx(1.5, abs=0.02)
    for size in (1.0, 2.0):
        assert 3.0 < max(p.high[2] for p in tree(0, 0, size, rng)) < 10.0
    assert max(p.high[2] for p in lamp(0, 0)) < 4.6
    assert bush(0, 0, 0.6, rng)[0].low[2] < 0
    assert forest(0, 0, 4.0, rng).high[2] > 5
    assert max(p.high[2] for p in church(48.0, rng)) > 18

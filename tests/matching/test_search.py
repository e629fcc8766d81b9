import numpy as np
import pytest

from closerange.errors import InputError
from closerange.flags import Flag
from closerange.geometry.transform import RigidTransform, rotation_from_vector
from closerange.matching.search import (
    between_planes,
    checked_volume,
    epipolar_segment,
    inside_image,
    plane_mapping,
    sight_line,
    upper_plane_mapping,
)
from closerange.rig.camera import Camera
from closerange.rig.distortion import BrownIdeal, BrownObserved
from closerange.verification.scenes import looking_at_origin

BOX = np.array([[-60.0, -50.0, -40.0], [60.0, 50.0, 40.0]])
STRONG = BrownIdeal(k1=-0.35, k2=0.1, p1=0.004, p2=-0.003)
OBSERVED = BrownObserved(k1=2e-7, k2=1e-13, p1=2e-6, centre_px=(300, 260))


def _pair(lens=None, *, focal=900.0, angle=0.3, distance=500.0, size=(640, 512)):
    return [
        looking_at_origin(
            name,
            angle_rad=turn,
            distance_mm=distance,
            focal_px=focal,
            centre_offset_px=(7.0, -5.0),
            distortion=lens,
            size_px=size,
        )
        for name, turn in (("left", -angle), ("right", angle * 0.8))
    ]


def _pixels(camera, count=60, seed=2):
    rng = np.random.default_rng(seed)
    width, height = camera.size_px
    return rng.uniform((-0.5, -0.5), (width - 0.5, height - 0.5), (count, 2))


def _rolled(camera, roll=2.1):
    """Turn a camera about its optical axis and tip it a little."""
    pose = camera.camera_from_world
    turn = rotation_from_vector([0.03, -0.05, roll])
    return Camera(
        camera.name,
        camera.size_px,
        camera.matrix_px,
        RigidTransform(turn @ pose.rotation, turn @ pose.translation_mm),
        camera.distortion,
    )


def _steps(segments):
    return np.linalg.norm(np.diff(segments.xy_px, axis=1), axis=2)


# --- sight lines -----------------------------------------------------------------------------


@pytest.mark.parametrize("lens", [None, STRONG, OBSERVED])
def test_ends_of_a_sight_line_lie_on_the_walls_and_project_to_the_pixel(lens):
    camera = _rolled(_pair(lens)[0])
    pixels = _pixels(camera, 400)
    lines = sight_line(camera, pixels, BOX)
    met = lines.flags == 0
    assert 50 < met.sum() < 400
    for distance in (lines.near_mm, lines.far_mm):
        xyz = lines.at(distance)[met]
        gap = np.minimum(np.abs(xyz - BOX[0]), np.abs(xyz - BOX[1])).min(axis=1)
        assert gap.max() < 1e-9
        assert ((xyz >= BOX[0] - 1e-9) & (xyz <= BOX[1] + 1e-9)).all()
        assert np.abs(camera.project(xyz) - pixels[met]).max() < 1e-8
    assert (lines.near_mm[met] <= lines.far_mm[met]).all()
    assert np.isnan(lines.near_mm[~met]).all()
    assert set(lines.flags[~met]) == {Flag.outside_volume}
    # brute force: those that miss have no point in the box anywhere
    along = lines.at(np.broadcast_to(np.linspace(300, 700, 2001), (400, 2001)))
    within = ((along >= BOX[0]) & (along <= BOX[1])).all(axis=2).any(axis=1)
    assert not within[~met].any()


def test_two_planes_are_equation_5_2():
    camera = _rolled(_pair()[0])
    pixels = _pixels(camera)
    lines = sight_line(camera, pixels, between_planes(-40, 30))
    assert not lines.flags.any()
    p = camera.projection_matrix
    for z, distance in ((30.0, lines.near_mm), (-40.0, lines.far_mm)):
        for pixel, xyz in zip(pixels, lines.at(distance), strict=True):
            # (5.2): two linear equations in X and Y at a given Z
            rows = np.array([p[0] - pixel[0] * p[2], p[1] - pixel[1] * p[2]])
            xy = np.linalg.solve(rows[:, :2], -rows[:, 2] * z - rows[:, 3])
            assert np.abs(xyz - [*xy, z]).max() < 1e-9


def test_a_volume_behind_the_camera_is_behind_and_not_measured():
    camera = _pair()[0]
    centre = camera.centre_mm
    ahead = camera.camera_from_world.rotation[2]
    middle = centre - 300 * ahead
    lines = sight_line(camera, [[320.0, 256.0]], [middle - 50, middle + 50])
    assert lines.flags.tolist() == [Flag.behind_camera]
    assert np.isnan([lines.near_mm, lines.far_mm]).all()


def test_a_camera_inside_the_volume_sees_from_its_centre_on():
    camera = _pair()[0]
    centre = camera.centre_mm
    lines = sight_line(camera, [[320.0, 256.0]], [centre - 10, centre + 10])
    assert lines.near_mm.tolist() == [0.0]
    assert 10 <= lines.far_mm[0] < 10 * np.sqrt(3)


def test_rays_along_a_slab():
    camera = Camera("c", (101, 101), np.diag([100.0, 100, 1]), RigidTransform(np.eye(3), [0, 0, 0]))
    middle = [[0.0, 0.0]]  # along +Z exactly
    inside = sight_line(camera, middle, [[-1, -1, 5], [1, 1, 7]])
    assert (inside.near_mm[0], inside.far_mm[0]) == (5, 7)
    assert sight_line(camera, middle, [[1, -1, 5], [2, 1, 7]]).flags[0] == Flag.outside_volume
    # between two planes X = const for ever: there is no end
    endless = [[-1, -np.inf, -np.inf], [1, np.inf, np.inf]]
    assert sight_line(camera, middle, endless).flags[0] == Flag.outside_volume
    # a flat volume is a plane
    flat = sight_line(camera, middle, [[-1, -1, 5], [1, 1, 5]])
    assert flat.near_mm[0] == flat.far_mm[0] == 5
    touching = sight_line(camera, middle, [[0, 0, 5], [1, 1, 7]])
    assert touching.flags[0] == 0


def test_pixels_that_do_not_exist_are_flagged():
    lens = BrownIdeal(k1=-0.6)  # turns back at a normalised radius of 0.75
    camera = _pair(lens, focal=300.0)[0]
    lines = sight_line(camera, [[np.nan, 3.0], [0.0, 0.0], [320.0, 256.0]], BOX)
    assert lines.flags.tolist() == [Flag.not_found, Flag.not_converged, 0]
    assert len(sight_line(camera, np.empty((0, 2)), BOX)) == 0


@pytest.mark.parametrize(
    ("volume", "message"),
    [
        ([[0, 0, 0], [1, 1, -1]], "Z runs from 0.0 to -1.0"),
        ([[0, np.nan, 0], [1, 1, 1]], "Y runs from nan"),
        ([[-np.inf] * 3, [np.inf] * 3], "no axis with two limits"),
        ([[-np.inf] * 3, [0, 0, 0]], "no axis with two limits"),
        ([0, 1, 2], "shape"),
    ],
)
def test_volumes_that_are_none_are_refused(volume, message):
    with pytest.raises(InputError, match=message):
        checked_volume(volume)


def test_planes_out_of_order_or_infinite_are_refused():
    with pytest.raises(InputError, match=r"Z runs from 50\.0 to -50\.0"):
        between_planes(50, -50)
    with pytest.raises(InputError, match="not finite"):
        between_planes(-50, np.inf)


def test_inside_image_ends_half_a_pixel_beyond_the_outer_centres():
    camera = _pair()[0]
    xy = [[-0.5, -0.5], [-0.51, 0], [639.5, 511.5], [639.51, 0], [0, 511.6], [np.nan, 1]]
    assert inside_image(camera, xy).tolist() == [True, False, True, False, False, False]


# --- epipolar segments -----------------------------------------------------------------------


@pytest.mark.parametrize("lens", [None, STRONG, OBSERVED])
@pytest.mark.parametrize("step", [0.5, 1.0, 3.0])
def test_segments_agree_with_direct_projection(lens, step):
    left, right = _pair(lens)
    right = _rolled(right)
    pixels = _pixels(left)
    volume = between_planes(-40, 40)
    segments = epipolar_segment(left, right, pixels, volume, step_px=step)
    assert (segments.count > 0).sum() > 40
    valid = segments.valid
    assert np.isfinite(segments.xy_px[valid]).all()
    assert np.isnan(segments.xy_px[~valid]).all()
    assert np.isnan(segments.distance_mm[~valid]).all()
    xyz = segments.xyz_mm
    direct = right.project(xyz[valid])
    assert np.abs(direct - segments.xy_px[valid]).max() < 1e-8
    back = np.repeat(pixels[:, None], valid.shape[1], axis=1)[valid]
    assert np.abs(left.project(xyz[valid]) - back).max() < 1e-8
    assert inside_image(right, segments.xy_px[valid]).all()
    assert np.nanmax(_steps(segments)) <= step * (1 + 1e-9)
    steps = np.diff(segments.distance_mm, axis=1)
    assert (steps[np.isfinite(steps)] > 0).all()  # from near to far


@pytest.mark.parametrize("lens", [None, STRONG, OBSERVED])
def test_ends_are_exact_and_nothing_in_the_image_is_left_out(lens):
    left, right = _pair(lens, focal=1100.0)
    right = _rolled(right)
    pixels = _pixels(left, 80)
    volume = between_planes(-150, 150)
    segments = epipolar_segment(left, right, pixels, volume)
    lines = segments.lines
    last = np.maximum(segments.count - 1, 0)
    some = segments.count > 0
    rows = np.flatnonzero(some)
    ends = (
        (segments.distance_mm[:, 0], segments.xy_px[:, 0], lines.near_mm),
        (
            segments.distance_mm[np.arange(80), last],
            segments.xy_px[np.arange(80), last],
            lines.far_mm,
        ),
    )
    cut = 0
    for distance, xy, limit in ends:
        at_limit = np.abs(distance - limit) < 1e-9
        width, height = right.size_px
        to_border = np.stack([xy[:, 0] + 0.5, width - 0.5 - xy[:, 0], xy[:, 1] + 0.5], axis=1)
        to_border = np.abs(np.column_stack([to_border, height - 0.5 - xy[:, 1]])).min(axis=1)
        at_border = to_border < 1e-8
        assert (at_limit | at_border)[rows].all()
        cut += int((at_border & ~at_limit)[rows].sum())
    assert cut > 20
    # brute force along each ray: what is seen in view 2 lies between the ends
    dense = np.linspace(lines.near_mm, lines.far_mm, 4001, axis=1)
    seen = inside_image(right, right.project(lines.at(dense).reshape(-1, 3))).reshape(dense.shape)
    assert not seen[~some].sum(axis=1).max(initial=0) > 20  # a corner, crossed within a step
    grid = (lines.far_mm - lines.near_mm) / 4000
    lowest = np.where(seen, dense, np.inf).min(axis=1)
    highest = np.where(seen, dense, -np.inf).max(axis=1)
    assert (lowest - ends[0][0] > -1e-9)[rows].all()
    assert (lowest - ends[0][0] <= grid + 1e-9)[rows].all()
    assert (ends[1][0] - highest <= grid + 1e-9)[rows].all()
    assert (ends[1][0] - highest > -1e-9)[rows].all()


def test_without_a_lens_it_is_the_line_of_the_fundamental_matrix():
    left, right = _pair()
    right = _rolled(right)
    pixels = _pixels(left, 200)
    segments = epipolar_segment(left, right, pixels, BOX)
    p1, p2 = left.projection_matrix, right.projection_matrix
    epipole = p2 @ np.append(left.centre_mm, 1)
    cross = np.cross(np.eye(3), epipole / np.linalg.norm(epipole))
    fundamental = -cross @ p2 @ np.linalg.pinv(p1)
    lines = np.column_stack([pixels, np.ones(len(pixels))]) @ fundamental.T
    lines /= np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    off = np.einsum("nkc,nc->nk", segments.xy_px, lines[:, :2]) + lines[:, 2:]
    assert np.nanmax(np.abs(off)) < 1e-8
    some = np.flatnonzero(segments.count > 2)
    assert len(some) > 15
    for row in some:
        curve = segments.xy_px[row, : segments.count[row]]
        even = np.linspace(curve[0], curve[-1], len(curve))
        assert np.abs(curve - even).max() < 1e-8  # (5.3): straight from end to end
        assert segments.length_px[row] == pytest.approx(np.linalg.norm(curve[-1] - curve[0]))
        assert len(curve) == np.ceil(segments.length_px[row] - 1e-9) + 1


def test_a_strong_lens_bends_the_segment():
    left, right = _pair(STRONG)
    segments = epipolar_segment(left, right, _pixels(left), between_planes(-150, 150))
    bends = []
    for row in np.flatnonzero(segments.count > 2):
        curve = segments.xy_px[row, : segments.count[row]]
        chord = curve[-1] - curve[0]
        normal = np.array([-chord[1], chord[0]]) / np.linalg.norm(chord)
        bends.append(np.abs((curve - curve[0]) @ normal).max())
    assert max(bends) > 2  # px (2.7 found); a search along the straight line would miss the match


def test_forward_looking_pair_with_the_epipole_inside_the_image():
    near = looking_at_origin("near", angle_rad=0.0, distance_mm=300.0, focal_px=700.0)
    back = looking_at_origin("back", angle_rad=0.02, distance_mm=600.0, focal_px=700.0)
    epipole = back.project([near.centre_mm])[0]
    assert inside_image(back, epipole)
    pixels = _pixels(near, 50)
    # the volume holds the front camera itself: each segment begins at the epipole
    volume = [[-900, -900, -100], [900, 900, 400]]
    segments = epipolar_segment(near, back, pixels, volume)
    assert (segments.count > 1).all()
    assert np.abs(segments.xy_px[:, 0] - epipole).max() < 1e-8
    valid = segments.valid
    direct = back.project(segments.xyz_mm[valid])
    assert np.abs(direct - segments.xy_px[valid]).max() < 1e-7
    # the other way round the first camera's centre lies behind the second: rays come from behind
    other = epipolar_segment(back, near, _pixels(back, 50), volume)
    valid = other.valid
    assert (near.depth_mm(other.xyz_mm[valid]) > 0).all()
    assert np.abs(near.project(other.xyz_mm[valid]) - other.xy_px[valid]).max() < 1e-7


def test_the_ray_through_the_other_camera_is_a_point_and_says_so():
    near = looking_at_origin("near", angle_rad=0.0, distance_mm=300.0, focal_px=700.0)
    back = looking_at_origin("back", angle_rad=0.02, distance_mm=600.0, focal_px=700.0)
    # the pixel of `back` that looks through the centre of `near`
    pixel = back.project([near.centre_mm])
    segments = epipolar_segment(back, near, pixel, BOX)
    assert segments.flags[0] & Flag.near_parallel
    # two cameras in one place see every ray as a point
    twin = _rolled(near, roll=0.1)
    pixels = _pixels(near, 20)
    both = epipolar_segment(near, twin, pixels, between_planes(-40, 40))
    seen = both.count > 0
    assert seen.sum() > 15
    assert (both.flags[seen] == Flag.near_parallel).all()
    # a plane is no reason for the flag
    flat = epipolar_segment(near, back, pixels, between_planes(0, 0))
    assert not (flat.flags & Flag.near_parallel).any()
    assert (flat.count[flat.flags == 0] >= 1).all()


def test_parallel_cameras_have_horizontal_segments():
    pose = [RigidTransform(np.diag([1.0, -1, -1]), [x, 0.0, 500.0]) for x in (0.0, -80.0)]
    matrix = np.array([[800.0, 0, 320], [0, 800, 256], [0, 0, 1]])
    left, right = (Camera(n, (640, 512), matrix, p) for n, p in zip("lr", pose, strict=True))
    pixels = _pixels(left, 40)
    segments = epipolar_segment(left, right, pixels, between_planes(-100, 100))
    rows = segments.xy_px[..., 1] - pixels[:, None, 1]
    assert np.nanmax(np.abs(rows)) < 1e-9
    whole = segments.count > 0
    disparity = pixels[:, 0] - segments.xy_px[:, 0, 0]
    uncut = whole & (np.abs(segments.distance_mm[:, 0] - segments.lines.near_mm) < 1e-9)
    assert np.allclose(disparity[uncut], 800 * 80 / 400)  # f B / Z of the near plane


def test_outside_and_behind_the_second_view_are_told_apart():
    left, right = _pair()
    looking_away = Camera(
        "away",
        right.size_px,
        right.matrix_px,
        RigidTransform(
            np.diag([-1.0, 1, -1]) @ right.camera_from_world.rotation,
            np.diag([-1.0, 1, -1]) @ right.camera_from_world.translation_mm,
        ),
    )
    middle = [[320.0, 250.0]]
    assert epipolar_segment(left, looking_away, middle, BOX).flags.tolist() == [Flag.behind_camera]
    aside = Camera(
        "aside",
        right.size_px,
        right.matrix_px,
        RigidTransform(
            rotation_from_vector([0, 0.9, 0]) @ right.camera_from_world.rotation,
            rotation_from_vector([0, 0.9, 0]) @ right.camera_from_world.translation_mm,
        ),
    )
    segments = epipolar_segment(left, aside, middle, BOX)
    assert segments.flags.tolist() == [Flag.outside_image]
    assert segments.count.tolist() == [0]
    assert segments.length_px.tolist() == [0]
    outside = epipolar_segment(left, right, [[0.0, 0.0], [320, 250], [np.nan, 1]], BOX)
    assert outside.flags.tolist() == [Flag.outside_volume, 0, Flag.not_found]
    assert outside.count[1] > 10
    assert len(epipolar_segment(left, right, np.empty((0, 2)), BOX)) == 0


def test_a_curve_that_leaves_the_image_and_comes_back_has_no_samples_outside():
    # a barrel bows a line outwards in its middle: beyond the border, while its ends are inside
    lens = BrownIdeal(k1=-0.15)
    _, right = _pair(lens, focal=500.0)
    top = right.undistort([[10.0, 3.0], [630.0, 3.0]])
    rays = right.directions([[10.0, 3.0], [630.0, 3.0]])
    start, end = right.centre_mm + 400 * rays[0], right.centre_mm + 400 * rays[1]
    assert np.isfinite(top).all()
    along = (end - start) / np.linalg.norm(end - start)
    # a first camera on that chord, whose middle pixel looks along it
    down = np.cross(along, [0.0, 0.0, 1.0])
    down /= np.linalg.norm(down)
    rotation = np.stack([np.cross(down, along), down, along])
    origin = start - 50 * along
    first = Camera(
        "first",
        (640, 512),
        np.array([[500.0, 0, 320], [0, 500, 256], [0, 0, 1]]),
        RigidTransform(rotation, -rotation @ origin),
    )
    corners = np.stack([start, end])
    volume = np.stack([corners.min(axis=0) - 1, corners.max(axis=0) + 1])
    segments = epipolar_segment(first, right, [[320.0, 256.0]], volume)
    curve = segments.xy_px[0, : segments.count[0]]
    assert inside_image(right, curve).all()
    steps = np.linalg.norm(np.diff(curve, axis=0), axis=1)
    assert (steps > 50).sum() == 1  # the gap
    assert np.sort(steps)[-2] <= 1 + 1e-9
    gap = int(np.argmax(steps))
    assert np.abs(curve[[gap, gap + 1], 1] + 0.5).max() < 1e-8  # it ends on the upper border


def test_a_lens_model_that_ends_inside_the_image_gives_no_made_up_samples():
    left, _ = _pair(focal=600.0)
    _, right = _pair(BrownIdeal(k1=-0.6), focal=330.0)
    segments = epipolar_segment(left, right, _pixels(left, 40), between_planes(-150, 300))
    valid = segments.valid
    assert np.isfinite(segments.xy_px[valid]).all()
    assert np.abs(right.project(segments.xyz_mm[valid]) - segments.xy_px[valid]).max() < 1e-7


@pytest.mark.parametrize("step", [0.0, -1.0, np.nan, np.inf])
def test_a_step_that_is_none_is_refused(step):
    left, right = _pair()
    with pytest.raises(InputError, match="a step of"):
        epipolar_segment(left, right, [[1.0, 1.0]], BOX, step_px=step)


# --- mapping by a plane ----------------------------------------------------------------------


@pytest.mark.parametrize("lens", [None, STRONG, OBSERVED])
def test_mapping_by_the_upper_plane_is_5_4_then_5_3(lens):
    left, right = _pair(lens)
    right = _rolled(right)
    pixels = _pixels(left)
    mapped = upper_plane_mapping(left, right, pixels, -40.0)
    assert np.abs(mapped.xyz_mm[:, 2] + 40).max() < 1e-9
    assert np.abs(left.project(mapped.xyz_mm) - pixels).max() < 1e-8
    assert np.abs(right.project(mapped.xyz_mm) - mapped.xy_px).max() < 1e-8
    # the plane is the far end of the segment between it and any nearer one
    segments = epipolar_segment(left, right, pixels, between_planes(-40, 10))
    last = segments.xy_px[np.arange(60), np.maximum(segments.count - 1, 0)]
    whole = inside_image(right, mapped.xy_px) & (segments.count > 0)
    assert whole.sum() > 30
    assert np.abs(last - mapped.xy_px)[whole].max() < 1e-8


@pytest.mark.parametrize("lens", [None, STRONG, OBSERVED])
def test_jacobian_of_the_mapping_is_that_of_finite_differences(lens):
    left, right = _pair(lens)
    right = _rolled(right)
    pixels = _pixels(left, 30)
    rng = np.random.default_rng(4)
    normal = rng.normal((0, 0, 1), 0.3, (30, 3))
    offset = rng.uniform(-30, 30, 30)

    def carried(xy):
        return plane_mapping(left, right, xy, normal=normal, offset_mm=offset)

    exact = carried(pixels)
    on_plane = np.einsum("ni,ni->n", exact.xyz_mm, normal) - offset
    assert np.abs(on_plane).max() < 1e-9
    h = 1e-4
    numeric = np.stack(
        [
            (carried(pixels + h * step).xy_px - carried(pixels - h * step).xy_px) / (2 * h)
            for step in np.eye(2)
        ],
        axis=2,
    )
    assert np.abs(exact.jacobian - numeric).max() < 1e-6
    assert np.abs(exact.jacobian).max() > 0.3


def test_a_plane_has_no_length_of_its_normal_and_one_for_each_pixel():
    left, right = _pair(STRONG)
    pixels = _pixels(left, 5)
    one = upper_plane_mapping(left, right, pixels, 12.0)
    other = plane_mapping(left, right, pixels, normal=(0, 0, -3.0), offset_mm=-36.0)
    assert np.allclose(one.xy_px, other.xy_px, rtol=0, atol=1e-9)
    assert np.allclose(one.jacobian, other.jacobian, rtol=0, atol=1e-9)
    each = upper_plane_mapping(left, right, pixels, np.full(5, 12.0))
    assert np.array_equal(each.xy_px, one.xy_px)


def test_where_the_way_is_barred_there_is_nan():
    left, right = _pair()
    # above the cameras, thus behind them; along the ray; no pixel
    assert np.isnan(upper_plane_mapping(left, right, [[320.0, 250.0]], 600.0).xy_px).all()
    middle = left.directions([[320.0, 250.0]])[0]
    normal = np.cross(middle, [0.0, 1.0, 0.0])
    along = plane_mapping(left, right, [[320.0, 250.0]], normal=normal, offset_mm=1e6)
    assert np.isnan(along.xyz_mm).all()
    assert np.isnan(along.jacobian).all()
    both = upper_plane_mapping(left, right, [[np.nan, 1.0], [320.0, 250.0]], 0.0)
    assert np.isfinite(both.xy_px).all(axis=1).tolist() == [False, True]
    assert len(upper_plane_mapping(left, right, np.empty((0, 2)), 0.0).xy_px) == 0

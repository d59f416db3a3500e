use std::collections::HashSet;

use holod_calibration::{Metres, PerColour};
use holod_model::LinearImage;
use holod_model::refocus::{CardArea, FAR_CARD, NEAR_CARD};
use holod_model::scene_shard::SceneShard;
use proptest::prelude::*;

use super::families::Family;
use super::grid::Grid;
use super::shard::{Outcome, PlanePlan, PlannedScene, Preview, PupilPlan, ShardError, ShardPlan, file_name};
use super::surface::{Bounds, Mesh, Ray, Shape, Vertex};
use super::view::{Aim, View, nearest_first};
use super::*;

const SIZE: Resolution = Resolution { width: 96, height: 96 };
const BENCH: DisplayGeometry = DisplayGeometry::DEFAULT;
/// 10.7 px a dioptre and millimetre of pupil over 3 dioptres, where the default has 5 over 2.86.
const GAEA: DisplayGeometry = DisplayGeometry {
    pixel_pitch: Metres(3.74e-6),
    wavelengths: PerColour([Metres(633e-9), Metres(532e-9), Metres(473e-9)]),
    depth_far: Dioptres(0.5),
    depth_near: Dioptres(3.5),
    ..DisplayGeometry::DEFAULT
};

fn mm(pupil_mm: f32) -> PupilDiameter {
    PupilDiameter::from_mm(pupil_mm)
}

fn facing(depth: f32) -> Shape {
    Shape::Plane { cx: 0.0, cy: 0.0, depth, gx: 0.0, gy: 0.0 }
}

fn everywhere() -> Bounds {
    Bounds { left: -120.0, right: 120.0, top: -120.0, bottom: 120.0 }
}

fn scene(surfaces: Vec<Surface>) -> Scene {
    Scene { surfaces, resolution: SIZE, ray_key: 1, pixel_samples: PixelSamples::Lattice }
}

/// A bright disc of two pixels' radius at `depth`, before black at infinity.
fn point_scene(depth: f32) -> Scene {
    let bounds = Bounds { left: -2.0, right: 2.0, top: -2.0, bottom: 2.0 };
    let disc = Surface::bake(facing(depth), bounds, |x, y| (x.hypot(y) < 2.0).then_some([1.0, 0.5, 0.25]));
    scene(vec![Surface::bake(facing(0.0), everywhere(), |_, _| Some([0.0; 3])), disc])
}

/// Energy, and diameter of the uniform disc of the same second moment, of the first channel of one image.
fn energy_and_diameter(image: &[f32]) -> (f64, f64) {
    let (mut energy, mut moment) = (0.0, 0.0);
    for (pixel, &value) in image[..SIZE.pixels()].iter().enumerate() {
        let x = (pixel % SIZE.width) as f64 + 0.5 - 0.5 * SIZE.width as f64;
        let y = (pixel / SIZE.width) as f64 + 0.5 - 0.5 * SIZE.height as f64;
        energy += f64::from(value);
        moment += f64::from(value) * (x * x + y * y);
    }
    // A uniform disc of radius R has the mean square distance R²/2.
    (energy, 2.0 * (2.0 * moment / energy).sqrt())
}

/// Whether a point at `depth` blurs, for an eye focused at `focus`, to the disc that `predicted_px` says.
fn blurs_to(depth: f32, focus: f64, pupil: PupilDiameter, predicted_px: f64) -> bool {
    let scene = point_scene(depth);
    let picture = scene.picture();
    let stack = scene.focal_stack(pupil, &[Dioptres(0.0), Dioptres(focus), Dioptres(1.0 / 0.35)], 96);
    let (sharp_energy, sharp_diameter) = energy_and_diameter(&picture.image);
    let (energy, diameter) = energy_and_diameter(&stack[3 * SIZE.pixels()..6 * SIZE.pixels()]);
    // Second moments of a convolution add.
    let blur_diameter = (diameter * diameter - sharp_diameter * sharp_diameter).max(0.0).sqrt();
    (energy / sharp_energy - 1.0).abs() < 0.06 && (blur_diameter - predicted_px).abs() < 0.03 * predicted_px + 0.3
}

#[test]
fn a_point_blurs_to_the_circle_of_confusion_and_keeps_its_energy() {
    let geometry = DisplayGeometry::DEFAULT;
    for (depth, focus, pupil) in [(0.5, 2.5, mm(3.0)), (2.4, 0.3, mm(4.0)), (1.6, 0.4, mm(1.5)), (0.1, 2.0, mm(5.0))] {
        let predicted_px = geometry.coc_px(pupil, Dioptres(f64::from(depth)), Dioptres(focus));
        assert!(blurs_to(depth, focus, pupil, predicted_px), "depth {depth}, focus {focus}, {pupil:?}");
    }
}

#[test]
fn a_wrong_circle_of_confusion_is_noticed() {
    let predicted_px = DisplayGeometry::DEFAULT.coc_px(mm(3.0), Dioptres(0.5), Dioptres(2.5));
    assert!(!blurs_to(0.5, 2.5, mm(3.0), 1.1 * predicted_px));
    assert!(!blurs_to(0.5, 2.5, mm(3.3), predicted_px));
    assert!(!blurs_to(0.5, 2.3, mm(3.0), predicted_px));
}

/// Root mean square difference of two images [3, H, W] within columns `from..to` and rows away from the border.
fn difference(a: &[f32], b: &[f32], resolution: Resolution, columns: std::ops::Range<usize>) -> f64 {
    let (mut sum, mut count) = (0.0, 0);
    for channel in 0..3 {
        for row in 16..resolution.height - 16 {
            for column in columns.clone() {
                let pixel = (channel * resolution.height + row) * resolution.width + column;
                sum += f64::from(a[pixel] - b[pixel]).powi(2);
                count += 1;
            }
        }
    }
    (sum / f64::from(count)).sqrt()
}

#[test]
fn a_card_in_focus_is_the_picture_and_out_of_focus_is_not() {
    let resolution = Resolution { width: 128, height: 128 };
    for dark_on_bright in [true, false] {
        let scene = Scene::cards(dark_on_bright, resolution);
        let picture = scene.picture();
        let stack = scene.focal_stack(mm(3.0), &[Dioptres(0.25), Dioptres(2.5)], 128);
        let (focused_far, focused_near) = stack.split_at(3 * resolution.pixels());
        let (near_card, far_card) = (12..52, 92..116);
        let sharp_near = difference(&picture.image, focused_near, resolution, near_card.clone());
        let sharp_far = difference(&picture.image, focused_far, resolution, far_card.clone());
        let soft_near = difference(&picture.image, focused_far, resolution, near_card);
        let soft_far = difference(&picture.image, focused_near, resolution, far_card);
        assert!(sharp_near < 0.03 && sharp_far < 0.03, "in focus: {sharp_near} near, {sharp_far} far");
        assert!(soft_near > 0.15 && soft_far > 0.15, "out of focus: {soft_near} near, {soft_far} far");
    }
}

#[test]
fn the_nearer_surface_hides_the_farther_whatever_the_order() {
    let half = Bounds { right: 0.0, ..everywhere() };
    let near = || Surface::bake(facing(2.0), half, |_, _| Some([1.0, 0.0, 0.0]));
    let far = || Surface::bake(facing(0.5), everywhere(), |_, _| Some([0.0, 1.0, 0.0]));
    for scene in [scene(vec![near(), far()]), scene(vec![far(), near()])] {
        let picture = scene.picture();
        let stack = scene.focal_stack(mm(2.0), &[Dioptres(0.5), Dioptres(2.0)], 64);
        let row = SIZE.width * (SIZE.height / 2);
        let red = |column: usize| stack[row + column];
        let green = |column: usize| stack[SIZE.pixels() + row + column];
        assert_eq!((picture.image[row + 47], picture.image[row + 48]), (1.0, 0.0));
        assert!(picture.depth[row + 47] > 0.69 && picture.depth[row + 48] < 0.18);
        // The near edge, blurred over 15 px when the eye focuses far: half of each at the edge, all of one beyond it.
        assert_eq!((red(39), green(39), red(57), green(57)), (1.0, 0.0, 0.0, 1.0));
        assert!((red(47) - 0.54).abs() < 0.1 && (green(48) - 0.54).abs() < 0.1, "{} {}", red(47), green(48));
    }
}

#[test]
fn outcome_depends_on_kind_seed_and_index_but_not_on_threads() {
    let focus = [Dioptres(0.0), Dioptres(2.0)];
    let render = |threads: usize, kind, seed, index| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a small pool");
        pool.install(|| {
            let scene = Scene::random(kind, seed, index, Resolution { width: 64, height: 48 });
            (scene.picture(), scene.focal_stacks(&[mm(1.0), mm(3.0)], &focus, 8))
        })
    };
    let first = render(1, SceneKind::Train, 5, 3);
    assert!(first == render(3, SceneKind::Train, 5, 3));
    for (kind, seed, index) in [(SceneKind::Train, 5, 4), (SceneKind::Train, 6, 3), (SceneKind::Test, 5, 3)] {
        assert!(first.0 != render(1, kind, seed, index).0);
    }
}

#[test]
fn shared_rays_agree_with_rays_of_ones_own() {
    let scene = Scene::random(SceneKind::Train, 2, 1, SIZE);
    let focus = [Dioptres(0.0), Dioptres(2.8)];
    // Given out of order, as a caller may.
    let together = scene.focal_stacks(&[mm(4.0), mm(2.0)], &focus, 128);
    for (stack, pupil) in together.iter().zip([mm(4.0), mm(2.0)]) {
        let error = noise(stack, &scene.focal_stack(pupil, &focus, 256));
        assert!(error < 0.02, "{pupil:?}: {error}");
    }
    assert!(noise(&together[0], &together[1]) > 0.03, "the two pupils' images must differ");
}

/// Root mean square difference.
fn noise(a: &[f32], b: &[f32]) -> f64 {
    let sum: f64 = a.iter().zip(b).map(|(x, y)| f64::from(x - y).powi(2)).sum();
    (sum / a.len() as f64).sqrt()
}

#[test]
fn noise_falls_faster_than_that_of_independent_rays() {
    let focus = [0.0, 0.5 / 0.35, 1.0 / 0.35].map(Dioptres);
    let mut scene = Scene::random(SceneKind::Train, 1, 0, SIZE);
    let [coarse, fine] = [16, 256].map(|rays| scene.noise(&[mm(2.0), mm(4.0)], &focus, rays));
    for (coarse, fine) in coarse.iter().zip(&fine) {
        assert!(fine.all_db < -43.0 && fine.in_focus_db < -46.0, "{fine:?}");
        // Sixteen times as many independent rays would take away 12 dB.
        assert!(fine.all_db < coarse.all_db - 13.0, "{coarse:?} with 16 rays, {fine:?} with 256");
    }
}

#[test]
fn noise_is_measured_as_what_it_is() {
    let (pixels, focus) = (4000, [Dioptres(0.0), Dioptres(2.0)]);
    let mut random = random::Random::new(1, 2);
    let mut stack = |amplitude: f32| -> Vec<f32> {
        (0..6 * pixels).map(|_| 0.5 + amplitude * 12f32.sqrt() * (random.unit() - 0.5)).collect()
    };
    let (a, b) = (stack(0.01), stack(0.01));
    let measured = noise::noise_between(&vec![0.0; pixels], mm(3.0), &focus, &a, &b);
    // All is at infinity: in focus in the first plane, out of it in the second.
    for db in [measured.all_db, measured.in_focus_db, measured.out_of_focus_db] {
        assert!((db + 40.0).abs() < 0.3, "{measured:?}");
    }
    let halves = noise::noise_between(&vec![0.0; pixels], mm(3.0), &focus, &a, &vec![0.5; 6 * pixels]);
    assert!((halves.all_db + 43.0).abs() < 0.3, "{halves:?}: one noisy stack of two has half the noise");
}

#[test]
fn what_is_in_focus_equals_the_picture_at_every_pupil_and_depth() {
    let near_dpt = 1.0 / 0.35;
    for depth in [0.0, 0.4, 1.43, 2.8] {
        let card = |x: f32, y: f32| Some(if (x * 0.31 + y * 0.12).sin() > 0.2 { [0.9, 0.7, 0.1] } else { [0.1; 3] });
        let scene = scene(vec![Surface::bake(facing(depth), everywhere(), card)]);
        let picture = scene.picture();
        let focus = [Dioptres(0.0), Dioptres(f64::from(depth)), Dioptres(near_dpt)];
        for stack in scene.focal_stacks(&[mm(1.0), mm(3.0), mm(5.0)], &focus, 128) {
            let sharp = &stack[3 * SIZE.pixels()..6 * SIZE.pixels()];
            let error = noise(sharp, &picture.image);
            assert!(error < 0.009, "depth {depth}: {error}");
            let beside = noise(&sharp[1..], &picture.image[..picture.image.len() - 1]);
            assert!(beside > 0.05, "one pixel beside must not pass: {beside}");
        }
    }
}

#[test]
fn light_is_neither_lost_nor_won_by_blur() {
    // A pattern that repeats every 8 px over more than the picture: each pixel's disc weighs it alike.
    let period =
        |x: f32, y: f32| Some(if x.rem_euclid(8.0) < 3.0 && y.rem_euclid(8.0) < 5.0 { [0.8; 3] } else { [0.1; 3] });
    let scene = scene(vec![Surface::bake(facing(1.0), everywhere(), period)]);
    let mean = |image: &[f32]| image.iter().map(|&value| f64::from(value)).sum::<f64>() / image.len() as f64;
    let expected = mean(&scene.picture().image);
    let focus = [0.0, 1.0, 2.0, 1.0 / 0.35].map(Dioptres);
    for stack in scene.focal_stacks(&[mm(2.0), mm(5.0)], &focus, 64) {
        for plane in stack.chunks_exact(3 * SIZE.pixels()) {
            assert!((mean(plane) / expected - 1.0).abs() < 2e-3, "{} of {expected}", mean(plane));
        }
    }
}

/// The slow way: one ray against each surface, to check views with. Meshes by one triangle after another.
fn trace(surfaces: &[Surface], ray: &Ray) -> ([f32; 3], f32) {
    let (mut colour, mut nearest) = ([0.0; 3], f32::NEG_INFINITY);
    for surface in surfaces {
        if let Some(depth) = surface.shape.depth_along(ray)
            && depth > nearest
            && let Some(texel) = surface.texel_at(ray.x0 + ray.ax * depth, ray.y0 + ray.ay * depth)
        {
            (colour, nearest) = ([texel[0], texel[1], texel[2]], depth);
        }
    }
    (colour, nearest)
}

#[test]
fn views_show_what_each_of_their_rays_meets_first() {
    let grid = Grid { left: -40.3, top: -39.6, step: 1.0, columns: 80, rows: 81 };
    for (index, (ax, ay)) in [(0.0, 0.0), (11.0, -4.0), (-3.0, 9.5)].into_iter().enumerate() {
        let surfaces = compose::random_surfaces(SceneKind::Train, 4, index as u64, SIZE, mm(8.0));
        let flat: Vec<Surface> =
            surfaces.into_iter().filter(|surface| !matches!(surface.shape, Shape::Mesh(_))).collect();
        let mut view = View::new(grid);
        view.draw(&nearest_first(&flat), (grid.left, grid.top), Aim { ax, ay, grid_depth: 1.2 });
        let mut wrong = 0;
        for sample in 0..grid.columns * grid.rows {
            let x = grid.left + (sample % grid.columns) as f32;
            let y = grid.top + (sample / grid.columns) as f32;
            let (colour, depth) = trace(&flat, &Ray { x0: x - ax * 1.2, y0: y - ay * 1.2, ax, ay });
            let seen = [0, 1, 2].map(|channel| view.colours[channel][sample]);
            // Rounding may put a sample on the other side of a texel's edge.
            wrong += usize::from(seen != colour || (view.depth[sample] - depth).abs() > 1e-3);
        }
        assert!(wrong < 10, "aperture point {ax}, {ay}: {wrong} samples differ");
    }
}

#[test]
fn planes_differ_by_less_than_a_pixel_of_blur() {
    let largest = |plan: &str, mm: f32| {
        let planes = plan.parse::<PupilPlan>().expect("a plan").planes(&BENCH);
        (planes, DisplayGeometry::DEFAULT.largest_coc_px(self::mm(mm)) / (planes - 1) as f64)
    };
    for (plan, mm, expected) in [("2", 2.0, 30), ("1,3", 3.0, 44), ("4,2", 4.0, 59), ("strata:2", 5.0, 73)] {
        let (planes, step_px) = largest(plan, mm);
        assert_eq!(planes, expected);
        assert!(step_px < 1.0 && step_px * (planes - 1) as f64 / (planes - 2) as f64 >= 1.0, "{plan}: {step_px} px");
    }
}

#[test]
fn test_scenes_wear_what_no_training_scene_wears() {
    let names = |table: &[(Family, u32)]| table.iter().map(|&(family, _)| family).collect::<Vec<_>>();
    let (train, test) = (names(&families::TRAIN), names(&families::TEST));
    let both: Vec<Family> = train.iter().copied().filter(|family| test.contains(family)).collect();
    assert_eq!(both, families::SHARED);
    // And what is drawn is what the tables say: how each kind's patterns are made, by the variant of the pattern.
    let drawn = |kind| {
        let mut random = random::Random::new(3, 4);
        (0..2000).map(|_| std::mem::discriminant(&families::pattern(&mut random, kind))).collect::<HashSet<_>>()
    };
    let (train, test) = (drawn(SceneKind::Train), drawn(SceneKind::Test));
    // Flat, gradient, and the three sorts of print: text, dots, ticks.
    assert_eq!(train.intersection(&test).count(), 5);
    assert!(train.len() >= 12 && test.len() >= 11, "{} and {}", train.len(), test.len());
}

#[test]
fn larger_pictures_hold_more_objects() {
    let surfaces = |width, height| {
        let count = |index| Scene::random(SceneKind::Train, 3, index, Resolution { width, height }).surfaces.len();
        (0..3).map(count).sum::<usize>()
    };
    assert!(surfaces(384, 384) as f64 > 1.25 * surfaces(192, 192) as f64);
}

#[test]
fn every_kind_of_solid_is_closed_and_shaded() {
    let mut random = random::Random::new(8, 8);
    for _ in 0..40 {
        let solid = meshes::solid(&mut random, SceneKind::Train, (0.0, 0.0), 1.4, 20.0, 2.8);
        let mut view = View::new(Grid { left: 0.0, top: 0.0, step: 0.5, columns: 200, rows: 200 });
        view.draw(&[&solid], (-50.0, -50.0), Aim::PINHOLE);
        let covered = view.depth.iter().filter(|depth| depth.is_finite()).count();
        assert!((400..30_000).contains(&covered), "{covered} samples");
        let (low, high) =
            view.depth.iter().filter(|d| d.is_finite()).fold((9.0f32, 0.0f32), |(l, h), &d| (l.min(d), h.max(d)));
        assert!((0.0..2.8).contains(&low) && high < 2.86 && high > low);
        // No hole: a covered row has one run of samples, or two where a ring shows its hole.
        for row in view.depth.chunks_exact(200) {
            let runs = row.windows(2).filter(|pair| !pair[0].is_finite() && pair[1].is_finite()).count();
            assert!(runs <= 3, "{runs} runs in a row");
        }
    }
}

#[test]
fn shadows_fall_behind_their_casters_only() {
    let small = Bounds { left: -10.0, right: 10.0, top: -10.0, bottom: 10.0 };
    let bright = |depth, bounds| Surface::bake(facing(depth), bounds, |_, _| Some([0.8; 3]));
    let mut surfaces = vec![bright(1.0, everywhere()), bright(1.4, small)];
    let mean = |surfaces: &[Surface]| thin_lens::mean_light(surfaces, SIZE);
    let before = [mean(&surfaces[..1]), mean(&surfaces[1..])];
    shadow::cast(&mut random::Random::new(1, 1), &mut surfaces, 1);
    assert!(mean(&surfaces[..1]) < 0.99 * before[0] && mean(&surfaces[..1]) > 0.8 * before[0]);
    assert_eq!(mean(&surfaces[1..]), before[1]);
}

#[test]
fn random_scenes_are_lit_and_lie_within_the_depth_range() {
    for kind in [SceneKind::Train, SceneKind::Test] {
        for index in 0..3 {
            let scene = Scene::random(kind, 3, index, SIZE);
            assert!((12..=48).contains(&scene.surfaces.len()), "{} surfaces", scene.surfaces.len());
            let picture = scene.picture();
            let mean = picture.image.iter().sum::<f32>() / picture.image.len() as f32;
            assert!((0.1..0.45).contains(&mean), "{kind:?} {index}: mean {mean}");
            assert!(picture.image.iter().all(|value| (0.0..=1.0).contains(value)));
            assert!(picture.depth.iter().all(|value| (0.0..=1.0).contains(value)));
            let (low, high) = picture.depth.iter().fold((1.0f32, 0.0f32), |(l, h), &d| (l.min(d), h.max(d)));
            assert!(high - low > 0.4, "{kind:?} {index}: depths {low} to {high}");
        }
    }
}

#[test]
fn the_sample_scene_fills_any_resolution() {
    for (width, height) in [(256, 256), (320, 180), (180, 320)] {
        let resolution = Resolution { width, height };
        let picture = sample_scene(resolution).picture();
        let near = DisplayGeometry::DEFAULT.normalised_depth(Dioptres(2.5)) as f32;
        let far = DisplayGeometry::DEFAULT.normalised_depth(Dioptres(0.25)) as f32;
        let depth = |x: f64, y: f64| picture.depth[(y * height as f64) as usize * width + (x * width as f64) as usize];
        assert!((depth(0.235, 0.47) - near).abs() < 1e-4 && (depth(0.78, 0.42) - far).abs() < 1e-4);
        assert_eq!(depth(0.5, 0.02), 0.0);
    }
}

proptest! {
    #[test]
    fn rays_meet_planes_where_the_plane_says(
        x0 in -60.0f32..60.0, y0 in -60.0f32..60.0, ax in -12.5f32..12.5, ay in -12.5f32..12.5,
        depth in 0.2f32..2.6, gx in -0.02f32..0.02, gy in -0.02f32..0.02,
    ) {
        let shape = Shape::Plane { cx: 3.0, cy: -5.0, depth, gx, gy };
        let hit = shape.depth_along(&Ray { x0, y0, ax, ay }).expect("a plane this wide is met");
        let (x, y) = (x0 + ax * hit, y0 + ay * hit);
        prop_assert!((shape.depth_at(x, y).expect("a plane is everywhere") - hit).abs() < 1e-3);
    }

    #[test]
    fn rays_meet_ellipsoids_on_their_near_side(
        x in -0.6f32..0.6, y in -0.6f32..0.6, ax in -12.5f32..12.5, ay in -12.5f32..12.5,
    ) {
        let (cx, cy, depth, rx, ry, rd) = (4.0, -7.0, 1.5, 30.0, 40.0, 0.4);
        let shape = Shape::Ellipsoid { cx, cy, depth, rx, ry, rd };
        let ray = Ray { x0: cx + x * rx - ax * depth, y0: cy + y * ry - ay * depth, ax, ay };
        let hit = shape.depth_along(&ray).expect("a ray through the middle");
        let (dx, dy) = ((ray.x0 + ax * hit - cx) / rx, (ray.y0 + ay * hit - cy) / ry);
        prop_assert!(((dx * dx + dy * dy + ((hit - depth) / rd).powi(2)) - 1.0).abs() < 1e-3);
        prop_assert!(hit > depth);
    }

    #[test]
    fn meshes_and_planes_of_one_place_look_alike(
        ax in -12.5f32..12.5, ay in -12.5f32..12.5, depth in 0.5f32..2.4, gx in -0.01f32..0.01, gy in -0.01f32..0.01,
    ) {
        let plane = Shape::Plane { cx: 0.0, cy: 0.0, depth, gx, gy };
        let bounds = Bounds { left: -30.0, right: 30.0, top: -25.0, bottom: 25.0 };
        let paint = |x: f32, y: f32| Some([0.5 + 0.4 * (0.05 * x).sin(), 0.5 + 0.4 * (0.05 * y).cos(), 0.3]);
        let corner = |x: f32, y: f32| Vertex { x, y, depth: depth + gx * x + gy * y, u: x, v: y };
        let vertices = vec![corner(-30.0, -25.0), corner(30.0, -25.0), corner(30.0, 25.0), corner(-30.0, 25.0)];
        let mesh = Mesh { vertices, triangles: vec![[0, 1, 2], [0, 3, 2]] };
        let draw = |surface: Surface| {
            let mut view = View::new(Grid { left: 0.0, top: 0.0, step: 1.0, columns: 120, rows: 110 });
            view.draw(&[&surface], (-60.25, -55.5), Aim { ax, ay, grid_depth: 1.4 });
            view
        };
        let (flat, mesh) = (draw(Surface::bake(plane, bounds, paint)), draw(Surface::bake_mesh(mesh, bounds, paint)));
        let differing = |a: &[f32], b: &[f32]| a.iter().zip(b).filter(|(a, b)| **a != **b && (*a - *b).abs() > 0.02).count();
        prop_assert!(flat.depth.iter().filter(|depth| depth.is_finite()).count() > 2000);
        // Rounding may differ along the outline.
        prop_assert!(differing(&flat.depth, &mesh.depth) < 12);
        prop_assert!((0..3).all(|c| differing(&flat.colours[c], &mesh.colours[c]) < 12));
    }
}

#[test]
fn pupil_plans_are_read_and_refused() {
    assert_eq!("1, 2.5".parse(), Ok(PupilPlan::Fixed(vec![mm(1.0), mm(2.5)])));
    for index in 0..20 {
        let pupils = "strata:4".parse::<PupilPlan>().expect("a plan").pupils(&BENCH, SceneKind::Train, 1, index);
        for (part, pupil) in pupils.iter().enumerate() {
            assert!((1.0 + part as f32..2.0 + part as f32).contains(&pupil.mm()));
        }
    }
    for wrong in ["", "strata:0", "strata:x", "log-strata:0", "2,,3", "0", "21", "NaN", "-3"] {
        assert!(wrong.parse::<PupilPlan>().is_err(), "{wrong}");
    }
}

#[test]
fn strata_of_blur_are_equal_in_logarithm_on_any_bench() {
    let plan = "log-strata:4".parse::<PupilPlan>().expect("a plan");
    for bench in [BENCH, GAEA] {
        for index in 0..20 {
            for (part, pupil) in plan.pupils(&bench, SceneKind::Train, 1, index).into_iter().enumerate() {
                let place = 4.0 * (bench.largest_coc_px(pupil) / 5.0).ln() / (800.0f64 / 7.0 / 5.0).ln();
                assert!((part as f64 - 1e-3..part as f64 + 1.001).contains(&place), "{part}: {place}");
            }
        }
    }
}

#[test]
fn pupils_for_which_no_scenes_are_made_are_refused_by_their_blur() {
    let check = |pupils: &str, bench| pupils.parse::<PupilPlan>().expect("a plan").check(&bench);
    assert_eq!(check("0.35,8", BENCH), Ok(()));
    assert_eq!(check("0.17,7.7", GAEA), Ok(()));
    assert_eq!(check("log-strata:4", GAEA), Ok(()));
    let wide = check("1,8", GAEA).expect_err("257 px");
    for part in ["8 mm", "256.7 px", "5 to 250 px", "0.16 to 7.79 mm"] {
        assert!(wide.contains(part), "{wide}");
    }
    assert!(check("0.3,8", BENCH).is_err());
}

/// How a scene blurs depends on the blur over its depth volume in pixels: another bench's pupils see the same.
#[test]
fn a_scene_on_another_bench_is_the_same_scene_to_other_pupils() {
    let default = ShardPlan { pupils: PupilPlan::Fixed(vec![mm(2.0), mm(4.0)]), ..small_plan() };
    let mm_per_mm = BENCH.largest_coc_px(mm(1.0)) / GAEA.largest_coc_px(mm(1.0));
    let theirs = [2.0, 4.0].map(|pupil_mm| mm((pupil_mm * mm_per_mm) as f32));
    let gaea = ShardPlan { bench: GAEA, pupils: PupilPlan::Fixed(theirs.to_vec()), ..small_plan() };
    let stacks = |plan: &ShardPlan| {
        let PlannedScene { scene, pupils, focus } = plan.scene(3);
        scene.focal_stacks(&pupils, &focus, 24).concat()
    };
    let same = |a: &[f32], b: &[f32]| {
        let squared: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum();
        squared / (a.len() as f64) < 1e-8
    };
    let expected = stacks(&default);
    assert!(same(&stacks(&gaea), &expected));
    assert!(!same(&stacks(&ShardPlan { bench: GAEA, ..default.clone() }), &expected), "the comparison is blind");

    let folder = tempfile::tempdir().expect("a folder");
    gaea.write(folder.path(), 3, &Tracer::cpu()).expect("a shard");
    let bytes = std::fs::read(folder.path().join(file_name(3))).expect("the shard");
    let (_, header) = safetensors::SafeTensors::read_metadata(&bytes).expect("metadata");
    let metadata = header.metadata().clone().expect("strings");
    for (key, value) in [
        ("far_dpt", "0.5"),
        ("near_dpt", "3.5"),
        ("pixel_pitch_um", "3.74"),
        ("wavelengths_nm", "[633.0, 532.0, 473.0]"),
        ("focus_dpt", "[0.5, 2.0, 3.5]"),
    ] {
        assert_eq!(metadata[key], value, "{key}");
    }
}

/// A pupil that goes farther than usual misses nothing: a ray that met no surface would bring darkness, and a white
/// scene a grey border.
#[test]
fn scenes_have_room_for_the_widest_pupils() {
    let size = Resolution { width: 96, height: 64 };
    let widest = mm(17.5);
    for index in 0..4 {
        let mut scene = Scene::random_for(SceneKind::Train, 5, index, size, widest);
        scene.surfaces.iter_mut().for_each(Surface::whiten);
        let stack = scene.focal_stack(widest, &[BENCH.depth_near, BENCH.depth_far], 64);
        assert!(stack.iter().all(|light| (light - 1.0).abs() < 1e-4), "scene {index}");
    }
    let mut usual = Scene::random(SceneKind::Train, 5, 0, size);
    usual.surfaces.iter_mut().for_each(Surface::whiten);
    let stack = usual.focal_stack(widest, &[BENCH.depth_near], 64);
    assert!(stack.iter().any(|light| *light < 0.99), "the comparison is blind");
    assert!(
        Scene::random_for(SceneKind::Train, 5, 0, size, mm(3.0)).picture()
            == Scene::random(SceneKind::Train, 5, 0, size).picture()
    );
}

#[test]
fn strata_of_planes_hold_one_each_and_differ_between_scenes() {
    let of_scene = |index| PlanePlan::Strata(6).focus(&BENCH, SceneKind::Train, 1, index);
    let near_dpt = DisplayGeometry::DEFAULT.depth_near.0;
    let mut ends = (near_dpt, 0.0f64);
    for index in 0..200 {
        let focus = of_scene(index);
        assert_eq!(focus.len(), 6);
        for (part, focus) in focus.iter().enumerate() {
            let within = 6.0 * focus.0 / near_dpt - part as f64;
            assert!((0.0..=1.0).contains(&within), "{index} {part}: {focus:?}");
        }
        assert_ne!(focus, of_scene(index + 1));
        assert_eq!(focus, of_scene(index));
        ends = (ends.0.min(focus[0].0), ends.1.max(focus[5].0));
    }
    assert!(ends.0 < 0.03 && ends.1 > near_dpt - 0.03, "{ends:?}");
    assert_ne!(of_scene(0), PlanePlan::Strata(6).focus(&BENCH, SceneKind::Train, 2, 0));
    for (text, plan) in [("6", PlanePlan::Uniform(6)), ("strata:6", PlanePlan::Strata(6))] {
        assert_eq!(text.parse(), Ok(plan));
    }
    for wrong in ["", "1", "257", "-3", "strata:", "strata:1", "strata:257", "strata:auto", "auto"] {
        assert!(wrong.parse::<PlanePlan>().unwrap_err().contains(wrong), "{wrong}");
    }
    let uniform = PlanePlan::Uniform(3).focus(&BENCH, SceneKind::Train, 1, 0);
    assert_eq!(uniform, [0.0, 0.5 * near_dpt, near_dpt].map(Dioptres));
}

fn small_plan() -> ShardPlan {
    ShardPlan {
        kind: SceneKind::Train,
        seed: 11,
        resolution: Resolution { width: 32, height: 24 },
        bench: BENCH,
        pupils: PupilPlan::Fixed(vec![mm(1.0), mm(4.0)]),
        planes: PlanePlan::Uniform(3),
        rays: 4,
    }
}

#[test]
fn shards_hold_what_the_trainer_reads() {
    let folder = tempfile::tempdir().expect("a folder");
    small_plan().write(folder.path(), 7, &Tracer::cpu()).expect("a shard");
    let bytes = std::fs::read(folder.path().join(file_name(7))).expect("the shard");
    let tensors = safetensors::SafeTensors::deserialize(&bytes).expect("safetensors");
    let shape = |name: &str| tensors.tensor(name).map(|t| (t.dtype(), t.shape().to_vec())).expect("the tensor");
    assert_eq!(shape("image"), (safetensors::Dtype::F16, vec![3, 24, 32]));
    assert_eq!(shape("depth"), (safetensors::Dtype::F32, vec![24, 32]));
    assert_eq!(shape("stack_0"), (safetensors::Dtype::F16, vec![3, 3, 24, 32]));
    assert_eq!(shape("stack_1"), shape("stack_0"));
    let (_, header) = safetensors::SafeTensors::read_metadata(&bytes).expect("metadata");
    let metadata = header.metadata().clone().expect("strings");
    let value = |key: &str| metadata.get(key).map(String::as_str);
    assert_eq!((value("format"), value("generator")), (Some("holod-scene-1"), Some("2")));
    assert_eq!((value("seed"), value("index"), value("kind")), (Some("11"), Some("7"), Some("train")));
    assert_eq!(value("traced_by"), Some("cpu"));
    assert_eq!(value("pupils_mm"), Some("[1.0, 4.0]"));
    let focus: Vec<f64> = serde_json::from_str(value("focus_dpt").expect("focus")).expect("a list");
    assert_eq!(focus, [0.0, 0.5 / 0.35, 1.0 / 0.35]);
    let preview = Preview::read(&folder.path().join(file_name(7))).expect("a preview");
    let picture = Scene::random(SceneKind::Train, 11, 7, small_plan().resolution).picture();
    assert_eq!(preview.depth, picture.depth);
    assert!(preview.image.iter().zip(&picture.image).all(|(a, b)| (a - b).abs() < 1e-3));
}

#[test]
fn a_preview_shows_the_widest_pupil_wherever_it_is_among_them() {
    let folder = tempfile::tempdir().expect("a folder");
    let preview = |name: &str, pupils: [f32; 2]| {
        let plan = ShardPlan { pupils: PupilPlan::Fixed(pupils.map(mm).to_vec()), ..small_plan() };
        plan.write(&folder.path().join(name), 7, &Tracer::cpu()).expect("a shard");
        Preview::read(&folder.path().join(name).join(file_name(7))).expect("a preview").focused_near
    };
    assert_eq!(preview("falling", [4.0, 1.0]), preview("rising", [1.0, 4.0]));
}

#[test]
fn shards_of_random_planes_say_which_and_are_known_again() {
    let folder = tempfile::tempdir().expect("a folder");
    let plan = ShardPlan { planes: PlanePlan::Strata(3), ..small_plan() };
    assert!(matches!(plan.write(folder.path(), 7, &Tracer::cpu()), Ok(Outcome::Written { .. })));
    assert!(matches!(plan.write(folder.path(), 7, &Tracer::cpu()), Ok(Outcome::Present)));
    let bytes = std::fs::read(folder.path().join(file_name(7))).expect("the shard");
    let (_, header) = safetensors::SafeTensors::read_metadata(&bytes).expect("metadata");
    let told: Vec<f64> =
        serde_json::from_str(&header.metadata().as_ref().expect("strings")["focus_dpt"]).expect("a list");
    let focuses = |index| plan.focus(index).iter().map(|focus| focus.0).collect::<Vec<_>>();
    assert_eq!(told, focuses(7));
    assert_ne!(told, focuses(0));
    let preview = Preview::read(&folder.path().join(file_name(7))).expect("a preview");
    let scene = Scene::random(SceneKind::Train, 11, 7, plan.resolution);
    let traced = scene.focal_stacks(&[mm(1.0), mm(4.0)], &plan.focus(7), plan.rays).swap_remove(1);
    assert!(preview.focused_far.iter().zip(&traced).all(|(a, b)| (a - b).abs() < 1e-3), "another focus");
}

#[test]
fn writing_again_keeps_whole_shards_mends_cut_ones_and_refuses_others() {
    let folder = tempfile::tempdir().expect("a folder");
    let plan = small_plan();
    let path = folder.path().join(file_name(0));
    assert!(matches!(plan.write(folder.path(), 0, &Tracer::cpu()), Ok(Outcome::Written { rays_traced: 1.. })));
    let whole = Preview::read(&path).expect("a shard");
    assert!(matches!(plan.write(folder.path(), 0, &Tracer::cpu()), Ok(Outcome::Present)));

    let bytes = std::fs::read(&path).expect("the shard");
    for length in [0, 5, 200, bytes.len() - 1] {
        std::fs::write(&path, &bytes[..length]).expect("cut short");
        assert!(matches!(plan.write(folder.path(), 0, &Tracer::cpu()), Ok(Outcome::Written { .. })), "cut to {length}");
        assert_eq!(Preview::read(&path).expect("mended").focused_near, whole.focused_near);
    }
    let others = [
        ShardPlan { seed: 12, ..plan.clone() },
        ShardPlan { rays: 5, ..plan.clone() },
        ShardPlan { planes: PlanePlan::Uniform(4), ..plan.clone() },
        ShardPlan { planes: PlanePlan::Strata(3), ..plan.clone() },
        ShardPlan { resolution: Resolution { width: 24, height: 32 }, ..plan.clone() },
    ];
    for other in others {
        assert!(matches!(other.write(folder.path(), 0, &Tracer::cpu()), Err(ShardError::Occupied { .. })));
    }
    std::fs::write(&path, b"\x02\0\0\0\0\0\0\0[]").expect("something else");
    assert!(matches!(plan.write(folder.path(), 0, &Tracer::cpu()), Err(ShardError::Malformed { .. })));
    let names: Vec<_> =
        std::fs::read_dir(folder.path()).expect("the folder").flatten().map(|e| e.file_name()).collect();
    assert_eq!(names, [file_name(0).as_str()], "no partial file stays");
}

#[test]
fn a_folder_that_cannot_be_made_is_named() {
    let folder = tempfile::tempdir().expect("a folder");
    let blocked = folder.path().join("file");
    std::fs::write(&blocked, b"").expect("a file");
    let error = small_plan().write(&blocked.join("under"), 0, &Tracer::cpu()).expect_err("a file is in the way");
    assert!(error.to_string().contains("--out"), "{error}");
}

/// On the device that tests run on.
#[cfg(feature = "gpu")]
mod on_a_gpu {
    use holod_model::gpu::{Adapters, Gpu, GpuError};

    use super::*;

    fn test_gpu() -> Gpu {
        let adapters = if holod_tests::on_a_graphics_card() { Adapters::Hardware } else { Adapters::Software };
        Gpu::open(adapters.into()).unwrap_or_else(|error| panic!("{adapters:?} for tests: {error}"))
    }

    /// Mean squared difference in dB below the peak of 1, and the share of values more than 0.02 apart.
    fn apart(a: &[f32], b: &[f32]) -> (f64, f64) {
        let squares: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum();
        let far = a.iter().zip(b).filter(|(a, b)| (*a - *b).abs() > 0.02).count();
        (10.0 * (squares / a.len() as f64).log10(), far as f64 / a.len() as f64)
    }

    /// Texels are half floats there, and rounding may put a ray on the other side of an edge.
    fn agree(cpu: &[f32], gpu: &[f32]) -> bool {
        let (db, far) = apart(cpu, gpu);
        cpu.len() == gpu.len() && db < -70.0 && far < 1e-3
    }

    fn tracer(gpu: Gpu) -> Tracer {
        Tracer::on(gpu).expect("the shaders")
    }

    /// By the CPU and by the tracer.
    fn both(
        gpu: &Tracer,
        scene: &Scene,
        pupils: &[PupilDiameter],
        focus: &[Dioptres],
        rays: usize,
    ) -> [Vec<Vec<f32>>; 2] {
        [&Tracer::cpu(), gpu]
            .map(|tracer| scene.traced_focal_stacks(tracer, pupils, focus, rays).expect("the stacks").0)
    }

    fn assert_agree(what: &str, [cpu, gpu]: &[Vec<Vec<f32>>; 2]) {
        assert_eq!(cpu.len(), gpu.len());
        for (pupil, (cpu, gpu)) in cpu.iter().zip(gpu).enumerate() {
            assert!(agree(cpu, gpu), "{what}, pupil {pupil}: {:?}", apart(cpu, gpu));
        }
    }

    #[test]
    fn scenes_of_every_kind_are_those_of_the_cpu() {
        let gpu = tracer(test_gpu());
        let focus = [0.0, 0.7, 1.9, 2.857].map(Dioptres);
        let pupils = [mm(4.7), mm(1.2), mm(2.5)];
        for (kind, index) in [(SceneKind::Train, 0), (SceneKind::Train, 5), (SceneKind::Test, 3), (SceneKind::Cards, 1)]
        {
            // No multiple of a workgroup.
            let scene = Scene::random(kind, 3, index, Resolution { width: 70, height: 46 });
            assert_agree(&format!("{kind:?} {index}"), &both(&gpu, &scene, &pupils, &focus, 24));
        }
        let scene = sample_scene(Resolution { width: 46, height: 70 });
        assert_agree("the sample scene, one plane", &both(&gpu, &scene, &pupils[..1], &focus[1..2], 33));
    }

    #[test]
    fn what_does_not_fit_in_one_buffer_is_done_in_parts_or_refused() {
        let size = Resolution { width: 70, height: 46 };
        // Small textures, so that views and sums are the larger.
        let bounds = Bounds { left: -20.0, right: 20.0, top: -20.0, bottom: 20.0 };
        let card = |depth| Surface::bake(facing(depth), bounds, |x, y| Some([0.5 + 0.02 * x, 0.5 + 0.02 * y, 0.7]));
        let scene = Scene { resolution: size, ..scene(vec![card(0.4)]) };
        let focus = [0.0, 0.4, 0.9, 1.4, 2.0].map(Dioptres);
        let mut gpu = test_gpu();
        // Sums of three planes and the other two; three views for the narrow pupil and two for the wide one, and a
        // rest.
        gpu.largest_buffer = 153_000;
        let tracer_of_parts = tracer(gpu);
        assert_agree("in parts", &both(&tracer_of_parts, &scene, &[mm(1.0), mm(2.0)], &focus, 17));

        let mut gpu = test_gpu();
        gpu.largest_buffer = 8 * 6399;
        let refused = scene.traced_focal_stacks(&tracer(gpu), &[mm(1.0)], &focus, 4).err();
        let textures = "the scene's textures";
        assert!(
            matches!(refused, Some(GpuError::TooLarge { what, bytes: 51_200, .. }) if what == textures),
            "{refused:?}"
        );
    }

    #[test]
    fn solids_of_triangles_are_those_of_the_cpu() {
        let gpu = tracer(test_gpu());
        let mut random = random::Random::new(17, 0);
        for round in 0..6 {
            let solids = (0..3).map(|n| {
                let middle = (random.between(-12.0, 12.0), random.between(-12.0, 12.0));
                meshes::solid(&mut random, SceneKind::Train, middle, 1.0 + 0.5 * n as f32, 14.0, 2.8)
            });
            let scene = scene(solids.collect());
            let stacks = both(&gpu, &scene, &[mm(4.0)], &[Dioptres(0.3), Dioptres(2.0)], 24);
            assert!(stacks[0][0].iter().any(|light| *light > 0.05), "nothing is seen");
            assert_agree(&format!("round {round}"), &stacks);
        }
    }

    #[test]
    fn one_pixel_of_displacement_or_a_percent_of_light_is_noticed() {
        let scene = Scene::random(SceneKind::Train, 3, 0, SIZE);
        let stack = scene.focal_stack(mm(3.0), &[Dioptres(1.0)], 8);
        let mut moved = stack.clone();
        moved.rotate_right(1);
        assert!(agree(&stack, &stack.clone()) && !agree(&stack, &moved), "{:?}", apart(&stack, &moved));
        let brighter: Vec<f32> = stack.iter().map(|light| 1.01 * light).collect();
        assert!(!agree(&stack, &brighter), "{:?}", apart(&stack, &brighter));
        let mut one_wrong = stack.clone();
        one_wrong[77] += 0.2;
        assert!(!agree(&stack, &one_wrong));
    }
}

#[test]
fn marks_are_bright_near_and_far_and_all_else_is_exactly_black() {
    let resolution = Resolution { width: 192, height: 160 };
    for index in 0..3 {
        let scene = Scene::random(SceneKind::Marks, 4, index, resolution);
        let Picture { image, depth } = scene.picture();
        let pixels = resolution.pixels();
        let lit: Vec<usize> = (0..pixels).filter(|&pixel| image[pixel] > 0.0).collect();
        assert!(lit.iter().all(|pixel| pixel / resolution.width >= resolution.height / 2), "marks {index}");
        assert!((30..pixels / 20).contains(&lit.len()), "{} pixels of marks {index} are lit", lit.len());
        assert!(lit.iter().any(|&pixel| image[pixel] > 0.3));
        for dpt in [2.5, 0.25] {
            let wanted = DisplayGeometry::DEFAULT.normalised_depth(Dioptres(dpt)) as f32;
            let there = lit.iter().filter(|&&pixel| (depth[pixel] - wanted).abs() < 1e-3).count();
            assert!(5 * there > lit.len(), "{there} of {} lit pixels at {dpt} dpt", lit.len());
        }
        let stack = scene.focal_stack(PupilDiameter::from_mm(2.0), &[Dioptres(2.5), Dioptres(0.25)], 64);
        for (plane, view) in stack.chunks_exact(3 * pixels).enumerate() {
            assert!(view[..pixels / 4].iter().all(|&light| light == 0.0), "the top of plane {plane}");
            let (sharp, seen) = (image.iter().sum::<f32>(), view.iter().sum::<f32>());
            assert!((seen / sharp - 1.0).abs() < 0.05, "blur keeps the light: {seen} of {sharp} in plane {plane}");
        }
    }
}

#[test]
fn what_was_written_is_read_as_a_shard() {
    let folder = tempfile::tempdir().expect("a folder");
    let plan = ShardPlan { kind: SceneKind::Test, ..small_plan() };
    plan.write(folder.path(), 5, &Tracer::cpu()).expect("a shard");
    let shard = SceneShard::open_folder(folder.path(), None, &plan.bench).expect("the folder").remove(0);
    assert_eq!((shard.kind(), shard.seed(), shard.index()), ("test", plan.seed, 5));
    assert_eq!(shard.resolution(), plan.resolution);
    assert_eq!((shard.pupils(), shard.focuses()), (&plan.pupils(5)[..], &plan.focus(5)[..]));

    let PlannedScene { scene, pupils, focus } = plan.scene(5);
    let near = |found: &[f32], expected: &[f32]| {
        found.len() == expected.len() && found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-3)
    };
    let (frame, picture) = (shard.frame().expect("a frame"), scene.picture());
    let light: Vec<f32> = frame.amplitude.iter().map(|amplitude| amplitude * amplitude).collect();
    assert!(near(&light, &picture.image) && frame.depth_normalised == picture.depth);
    let stacks = scene.focal_stacks(&pupils, &focus, plan.rays);
    for (pupil, stack) in stacks.iter().enumerate() {
        let planes = shard.stack(pupil).expect("a stack");
        assert!(near(&planes.into_iter().flat_map(|plane| plane.pixels).collect::<Vec<_>>(), stack), "{pupil}");
    }
    assert!(stacks.len() > 1 && !near(&stacks[0], &stacks[1]), "the comparison is blind");
}

#[test]
fn cards_are_found_and_refocus_as_an_eye_sees_them() {
    let resolution = Resolution { width: 160, height: 160 };
    let scene = Scene::cards(true, resolution);
    let depth = scene.picture().depth;
    let pixels = scene.focal_stack(mm(4.0), &[NEAR_CARD, FAR_CARD], 128);
    let [near, far] = [0, 1].map(|plane| LinearImage {
        resolution,
        pixels: pixels[plane * 3 * resolution.pixels()..][..3 * resolution.pixels()].to_vec(),
    });
    let area = |card| CardArea::find(&depth, resolution, card, 8).expect("a card");
    let (near_card, far_card) = (area(NEAR_CARD), area(FAR_CARD));
    assert!(near_card.gradient_energy(&near) > 4.0 * near_card.gradient_energy(&far));
    assert!(far_card.gradient_energy(&far) > 4.0 * far_card.gradient_energy(&near));
}

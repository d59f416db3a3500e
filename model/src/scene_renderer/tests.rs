use proptest::prelude::*;

use super::shard::{Outcome, Preview, PupilPlan, ShardError, ShardPlan, file_name};
use super::surface::{Bounds, Ray, Shape};
use super::*;

const SIZE: Resolution = Resolution { width: 96, height: 96 };

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
    Scene { surfaces, resolution: SIZE, ray_key: 1 }
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
fn noise_falls_as_rays_rise() {
    let scene = Scene::random(SceneKind::Train, 9, 0, Resolution { width: 64, height: 64 });
    let focus = [Dioptres(0.0), Dioptres(1.4), Dioptres(2.8)];
    let reference = scene.focal_stack(mm(2.0), &focus, 1500);
    let [coarse, fine] = [16, 144].map(|rays| noise(&scene.focal_stack(mm(2.0), &focus, rays), &reference));
    assert!(fine < coarse / 2.5, "{coarse} with 16 rays, {fine} with 144");
    assert!(fine < 0.02, "{fine} with 144 rays");
}

#[test]
fn random_scenes_are_lit_and_lie_within_the_depth_range() {
    for kind in [SceneKind::Train, SceneKind::Test] {
        for index in 0..6 {
            let scene = Scene::random(kind, 3, index, SIZE);
            assert!((15..=44).contains(&scene.surfaces.len()), "{} surfaces", scene.surfaces.len());
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
        let bounds = Bounds { left: -400.0, right: 400.0, top: -400.0, bottom: 400.0 };
        let surface = Surface::bake(shape, bounds, |_, _| Some([0.5; 3]));
        let ray = Ray { x0, y0, ax, ay };
        if let Some((hit, _)) = surface.hit(&ray, f32::NEG_INFINITY) {
            let (x, y) = (ray.x0 + ray.ax * hit, ray.y0 + ray.ay * hit);
            prop_assert!((shape.depth_at(x, y).expect("a plane is everywhere") - hit).abs() < 1e-3);
        } else {
            prop_assert!(false, "a plane this wide is met");
        }
    }

    #[test]
    fn rays_meet_ellipsoids_on_their_near_side(
        x in -0.6f32..0.6, y in -0.6f32..0.6, ax in -12.5f32..12.5, ay in -12.5f32..12.5,
    ) {
        let (cx, cy, depth, rx, ry, rd) = (4.0, -7.0, 1.5, 30.0, 40.0, 0.4);
        let surface = Surface::bake(
            Shape::Ellipsoid { cx, cy, depth, rx, ry, rd },
            Bounds { left: cx - rx, right: cx + rx, top: cy - ry, bottom: cy + ry },
            |_, _| Some([0.5; 3]),
        );
        let ray = Ray { x0: cx + x * rx - ax * depth, y0: cy + y * ry - ay * depth, ax, ay };
        let (hit, _) = surface.hit(&ray, f32::NEG_INFINITY).expect("a ray through the middle");
        let (dx, dy) = ((ray.x0 + ax * hit - cx) / rx, (ray.y0 + ay * hit - cy) / ry);
        prop_assert!(((dx * dx + dy * dy + ((hit - depth) / rd).powi(2)) - 1.0).abs() < 1e-3);
        prop_assert!(hit > depth);
    }
}

#[test]
fn pupil_plans_are_read_and_refused() {
    assert_eq!("1, 2.5".parse(), Ok(PupilPlan::Fixed(vec![mm(1.0), mm(2.5)])));
    for index in 0..20 {
        let pupils = "strata:4".parse::<PupilPlan>().expect("a plan").pupils(SceneKind::Train, 1, index);
        for (part, pupil) in pupils.iter().enumerate() {
            assert!((1.0 + part as f32..2.0 + part as f32).contains(&pupil.mm()));
        }
    }
    for wrong in ["", "strata:0", "strata:x", "2,,3", "0.1", "12", "NaN", "-3"] {
        assert!(wrong.parse::<PupilPlan>().is_err(), "{wrong}");
    }
}

fn small_plan() -> ShardPlan {
    ShardPlan {
        kind: SceneKind::Train,
        seed: 11,
        resolution: Resolution { width: 32, height: 24 },
        pupils: PupilPlan::Fixed(vec![mm(1.0), mm(4.0)]),
        planes: 3,
        rays: 4,
    }
}

#[test]
fn shards_hold_what_the_trainer_reads() {
    let folder = tempfile::tempdir().expect("a folder");
    small_plan().write(folder.path(), 7).expect("a shard");
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
    assert_eq!(value("format"), Some("holod-scene-1"));
    assert_eq!((value("seed"), value("index"), value("kind")), (Some("11"), Some("7"), Some("train")));
    assert_eq!(value("pupils_mm"), Some("[1.0, 4.0]"));
    let focus: Vec<f64> = serde_json::from_str(value("focus_dpt").expect("focus")).expect("a list");
    assert_eq!(focus, [0.0, 0.5 / 0.35, 1.0 / 0.35]);
    let preview = Preview::read(&folder.path().join(file_name(7))).expect("a preview");
    let picture = Scene::random(SceneKind::Train, 11, 7, small_plan().resolution).picture();
    assert_eq!(preview.depth, picture.depth);
    assert!(preview.image.iter().zip(&picture.image).all(|(a, b)| (a - b).abs() < 1e-3));
}

#[test]
fn writing_again_keeps_whole_shards_mends_cut_ones_and_refuses_others() {
    let folder = tempfile::tempdir().expect("a folder");
    let plan = small_plan();
    let path = folder.path().join(file_name(0));
    assert!(matches!(plan.write(folder.path(), 0), Ok(Outcome::Written { rays_traced: 1.. })));
    let whole = Preview::read(&path).expect("a shard");
    assert!(matches!(plan.write(folder.path(), 0), Ok(Outcome::Present)));

    let bytes = std::fs::read(&path).expect("the shard");
    for length in [0, 5, 200, bytes.len() - 1] {
        std::fs::write(&path, &bytes[..length]).expect("cut short");
        assert!(matches!(plan.write(folder.path(), 0), Ok(Outcome::Written { .. })), "cut to {length}");
        assert_eq!(Preview::read(&path).expect("mended").focused_near, whole.focused_near);
    }
    let others = [
        ShardPlan { seed: 12, ..plan.clone() },
        ShardPlan { rays: 5, ..plan.clone() },
        ShardPlan { planes: 4, ..plan.clone() },
        ShardPlan { resolution: Resolution { width: 24, height: 32 }, ..plan.clone() },
    ];
    for other in others {
        assert!(matches!(other.write(folder.path(), 0), Err(ShardError::Occupied { .. })));
    }
    std::fs::write(&path, b"\x02\0\0\0\0\0\0\0[]").expect("something else");
    assert!(matches!(plan.write(folder.path(), 0), Err(ShardError::Malformed { .. })));
    let names: Vec<_> =
        std::fs::read_dir(folder.path()).expect("the folder").flatten().map(|e| e.file_name()).collect();
    assert_eq!(names, [file_name(0).as_str()], "no partial file stays");
}

#[test]
fn a_folder_that_cannot_be_made_is_named() {
    let folder = tempfile::tempdir().expect("a folder");
    let blocked = folder.path().join("file");
    std::fs::write(&blocked, b"").expect("a file");
    let error = small_plan().write(&blocked.join("under"), 0).expect_err("a file is in the way");
    assert!(error.to_string().contains("--out"), "{error}");
}

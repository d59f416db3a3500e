//! How good a picture or a focal stack is. Intensities are linear light with white = 1.
//!
//! PSNR alone rewards one blurred picture that is shown at every focus, so a stack is judged by a row of figures: see
//! [`StackScore`].

mod foam;

use holod_calibration::{Colour, Dioptres, DisplayGeometry, PupilDiameter, Resolution};
use rayon::prelude::*;

use self::foam::Foam;
use crate::LinearImage;

/// Side and standard deviation of SSIM's window (Wang et al. 2004).
const SSIM_WINDOW: usize = 11;
const SSIM_SIGMA: f64 = 1.5;
/// Pixels blurred by less are in focus, pixels blurred by more than the other are out of focus.
const IN_FOCUS_COC_PX: f64 = 2.0;
const OUT_OF_FOCUS_COC_PX: f64 = 8.0;
/// A stack whose squared changes with focus sum to no more does not change.
const NO_CHANGE: f64 = 1e-12;

/// What of pictures is judged.
#[derive(Clone, Copy, Debug)]
pub struct Part<'a> {
    /// These colours, at least one.
    pub colours: &'a [Colour],
    /// Pixels at each edge that are left out.
    pub border_px: usize,
}

impl Part<'_> {
    /// All colours, without `border_px` at each edge.
    pub fn inside(border_px: usize) -> Self {
        Self { colours: &Colour::ALL, border_px }
    }
}

/// Peak signal-to-noise ratio in dB with peak 1, over all colours of `part`; infinite for equal pictures.
pub fn psnr_db(actual: &LinearImage, expected: &LinearImage, part: Part<'_>) -> f64 {
    assert_same_size(actual, expected);
    stack_psnr_db(std::slice::from_ref(actual), std::slice::from_ref(expected), part)
}

/// [`psnr_db`] over all pictures of a stack together.
pub fn stack_psnr_db(actual: &[LinearImage], expected: &[LinearImage], part: Part<'_>) -> f64 {
    assert_same_length(actual, expected);
    let mut error = SquaredError::default();
    for (actual, expected) in actual.iter().zip(expected) {
        assert_same_size(actual, expected);
        for_each_inside(actual.resolution, part, |index| {
            error.add(actual.pixels[index], expected.pixels[index]);
        });
    }
    error.psnr_db()
}

/// Structural similarity with an 11x11 Gaussian window of σ = 1.5 that lies wholly inside `part`, mean over pixels and
/// colours. `None` where no window fits.
pub fn ssim(actual: &LinearImage, expected: &LinearImage, part: Part<'_>) -> Option<f64> {
    assert_same_size(actual, expected);
    let Part { colours, border_px } = part;
    let Resolution { width, height } = actual.resolution;
    let (inner_width, inner_height) = (width.checked_sub(2 * border_px)?, height.checked_sub(2 * border_px)?);
    if inner_width < SSIM_WINDOW || inner_height < SSIM_WINDOW {
        return None;
    }
    let inner = |plane: &[f32]| -> Vec<f64> {
        let rows = plane.chunks_exact(width).skip(border_px).take(inner_height);
        rows.flat_map(|row| &row[border_px..][..inner_width]).map(|&value| f64::from(value)).collect()
    };
    let mean_of_planes = colours.par_iter().map(|&colour| {
        let (x, y) = (inner(actual.plane(colour)), inner(expected.plane(colour)));
        let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).collect::<Vec<_>>();
        let windowed = |plane: &[f64]| gaussian_means(plane, inner_width);
        let (mean_x, mean_y) = (windowed(&x), windowed(&y));
        let (square_x, square_y, cross) =
            (windowed(&product(&x, &x)), windowed(&product(&y, &y)), windowed(&product(&x, &y)));
        let (c1, c2) = (0.01f64.powi(2), 0.03f64.powi(2));
        let similarity = (0..mean_x.len()).map(|index| {
            let (mx, my) = (mean_x[index], mean_y[index]);
            let (vx, vy, cov) = (square_x[index] - mx * mx, square_y[index] - my * my, cross[index] - mx * my);
            (2.0 * mx * my + c1) * (2.0 * cov + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))
        });
        similarity.sum::<f64>() / mean_x.len() as f64
    });
    Some(mean_of_planes.sum::<f64>() / colours.len() as f64)
}

/// Sum of squared differences of neighbouring pixels, along x and y, over all colours and the rectangle of `columns`
/// and `rows`: how sharp that part is.
pub fn gradient_energy(image: &LinearImage, columns: std::ops::Range<usize>, rows: std::ops::Range<usize>) -> f64 {
    let width = image.resolution.width;
    let mut energy = 0.0;
    for colour in Colour::ALL {
        let plane = image.plane(colour);
        let at = |x: usize, y: usize| f64::from(plane[y * width + x]);
        for (y, x) in rows.clone().flat_map(|y| columns.clone().map(move |x| (y, x))) {
            if x + 1 < columns.end {
                energy += (at(x + 1, y) - at(x, y)).powi(2);
            }
            if y + 1 < rows.end {
                energy += (at(x, y + 1) - at(x, y)).powi(2);
            }
        }
    }
    energy
}

/// How a focal stack compares with its target.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StackScore {
    /// PSNR over all planes.
    pub psnr_db: f64,
    /// PSNR over the pixels with less than 2 px of blur; `None` where there is none.
    pub in_focus_psnr_db: Option<f64>,
    /// PSNR over the pixels with more than 8 px of blur; `None` where there is none.
    pub out_of_focus_psnr_db: Option<f64>,
    /// Slope of the regression of P_k − mean P on R_k − mean R: 1 is the target's full refocus, 0 the same picture at
    /// all planes. `None` where the target does not change with focus.
    pub focus_slope: Option<f64>,
    /// Correlation of the same two; 0 where only the pictures do not change with focus.
    pub focus_correlation: Option<f64>,
    /// [`ssim`], mean over planes; `None` where its window does not fit.
    pub ssim: Option<f64>,
    /// Mean energy, white = 1, of structure of 4 to 16 px that the pictures have with more than 8 px of blur and the
    /// target has not; `None` where no whole region of 32x32 px has a block with so much blur.
    pub foam: Option<f64>,
    /// PSNR of showing the target's mean at every plane: what no focus at all would score.
    pub flat_oracle_psnr_db: f64,
}

/// Judges the pictures `actual` against `expected`, seen by an eye with `pupil` at each of `focuses`, of a scene whose
/// normalised depth [height, width] is `depth_normalised`.
pub fn score_stack(
    actual: &[LinearImage],
    expected: &[LinearImage],
    focuses: &[Dioptres],
    depth_normalised: &[f32],
    geometry: &DisplayGeometry,
    pupil: PupilDiameter,
    part: Part<'_>,
) -> StackScore {
    let planes = expected.len();
    assert_same_length(actual, expected);
    assert!(planes > 0 && focuses.len() == planes, "stacks and focuses have one length");
    for (actual, expected) in actual.iter().zip(expected) {
        assert_same_size(actual, expected);
        assert_eq!(expected.resolution.pixels(), depth_normalised.len(), "depth has the pictures' size");
    }
    let resolution = expected[0].resolution;
    let (mut all, mut sharp, mut blurred, mut flat) =
        (SquaredError::default(), SquaredError::default(), SquaredError::default(), SquaredError::default());
    let (mut cross, mut actual_energy, mut expected_energy) = (0.0f64, 0.0f64, 0.0f64);
    for_each_inside(resolution, part, |index| {
        let mean = |stack: &[LinearImage]| {
            stack.iter().map(|image| f64::from(image.pixels[index])).sum::<f64>() / planes as f64
        };
        let (actual_mean, expected_mean) = (mean(actual), mean(expected));
        let depth = geometry.depth_at(depth_normalised[index % resolution.pixels()].into());
        for ((actual, expected), &focus) in actual.iter().zip(expected).zip(focuses) {
            let (shown, wanted) = (actual.pixels[index], expected.pixels[index]);
            let coc_px = geometry.coc_px(pupil, depth, focus);
            all.add(shown, wanted);
            flat.add(expected_mean as f32, wanted);
            if coc_px < IN_FOCUS_COC_PX {
                sharp.add(shown, wanted);
            } else if coc_px > OUT_OF_FOCUS_COC_PX {
                blurred.add(shown, wanted);
            }
            let (shown, wanted) = (f64::from(shown) - actual_mean, f64::from(wanted) - expected_mean);
            cross += shown * wanted;
            actual_energy += shown * shown;
            expected_energy += wanted * wanted;
        }
    });
    let refocuses = expected_energy > NO_CHANGE;
    let correlation = if actual_energy > NO_CHANGE { cross / (actual_energy * expected_energy).sqrt() } else { 0.0 };
    let ssims: Option<Vec<f64>> =
        actual.par_iter().zip(expected).map(|(actual, expected)| ssim(actual, expected, part)).collect();
    let foam = (0..planes).into_par_iter().map(|plane| {
        Foam::of(&actual[plane], &expected[plane], part, |index| {
            let depth = geometry.depth_at(depth_normalised[index].into());
            geometry.coc_px(pupil, depth, focuses[plane]) > OUT_OF_FOCUS_COC_PX
        })
    });
    let some = |error: SquaredError| (error.count > 0).then(|| error.psnr_db());
    StackScore {
        psnr_db: all.psnr_db(),
        in_focus_psnr_db: some(sharp),
        out_of_focus_psnr_db: some(blurred),
        focus_slope: refocuses.then(|| cross / expected_energy),
        focus_correlation: refocuses.then_some(correlation),
        ssim: ssims.map(|ssims| ssims.iter().sum::<f64>() / planes as f64),
        foam: foam.reduce(Foam::default, |one, other| one + other).mean(),
        flat_oracle_psnr_db: flat.psnr_db(),
    }
}

#[derive(Clone, Copy, Default)]
struct SquaredError {
    sum: f64,
    count: usize,
}

impl SquaredError {
    fn add(&mut self, actual: f32, expected: f32) {
        self.sum += (f64::from(actual) - f64::from(expected)).powi(2);
        self.count += 1;
    }

    fn psnr_db(self) -> f64 {
        -10.0 * (self.sum / self.count.max(1) as f64).log10()
    }
}

fn assert_same_length(actual: &[LinearImage], expected: &[LinearImage]) {
    assert_eq!(actual.len(), expected.len(), "stacks that are compared have one length");
}

fn assert_same_size(actual: &LinearImage, expected: &LinearImage) {
    assert_eq!(actual.resolution, expected.resolution, "pictures that are compared have one size");
}

/// Calls `visit` with each index into [3, height, width] that is in `part`.
fn for_each_inside(resolution: Resolution, part: Part<'_>, mut visit: impl FnMut(usize)) {
    let Resolution { width, height } = resolution;
    let Part { colours, border_px } = part;
    for colour in colours.iter().map(|colour| colour.index()) {
        for y in border_px..height.saturating_sub(border_px) {
            for x in border_px..width.saturating_sub(border_px) {
                visit((colour * height + y) * width + x);
            }
        }
    }
}

/// Gaussian-weighted means of every window that lies wholly inside `plane`, whose rows have `width` values.
fn gaussian_means(plane: &[f64], width: usize) -> Vec<f64> {
    let middle = (SSIM_WINDOW / 2) as f64;
    let weights: [f64; SSIM_WINDOW] =
        std::array::from_fn(|tap| (-0.5 * ((tap as f64 - middle) / SSIM_SIGMA).powi(2)).exp());
    let sum: f64 = weights.iter().sum();
    let weights = weights.map(|weight| weight / sum);
    let narrowed: Vec<f64> = plane
        .chunks_exact(width)
        .flat_map(|row| row.windows(SSIM_WINDOW).map(|window| window.iter().zip(weights).map(|(v, w)| v * w).sum()))
        .collect();
    let narrow = width + 1 - SSIM_WINDOW;
    let height = narrowed.len() / narrow;
    (0..(height + 1 - SSIM_WINDOW) * narrow)
        .map(|index| weights.iter().enumerate().map(|(tap, weight)| weight * narrowed[index + tap * narrow]).sum())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(width: usize, height: usize, value: impl Fn(usize) -> f32) -> LinearImage {
        let resolution = Resolution { width, height };
        LinearImage { resolution, pixels: (0..3 * resolution.pixels()).map(value).collect() }
    }

    fn wave(index: usize) -> f32 {
        0.5 + 0.4 * (index as f32 * 0.7).sin()
    }

    #[test]
    fn psnr_of_a_known_error() {
        let expected = image(8, 8, wave);
        let actual = image(8, 8, |index| wave(index) + 0.01);
        assert!((psnr_db(&actual, &expected, Part::inside(0)) - 40.0).abs() < 1e-3);
        assert_eq!(psnr_db(&expected, &expected, Part::inside(2)), f64::INFINITY);
        let mut spoiled = expected.clone();
        spoiled.pixels[0] += 1.0;
        assert!((psnr_db(&spoiled, &expected, Part::inside(0)) - 10.0 * 192f64.log10()).abs() < 1e-4);
        assert_eq!(psnr_db(&spoiled, &expected, Part::inside(1)), f64::INFINITY, "the border is left out");
    }

    #[test]
    fn ssim_is_one_for_equals_and_follows_its_formula_for_constants() {
        let expected = image(24, 20, wave);
        assert!((ssim(&expected, &expected, Part::inside(2)).unwrap() - 1.0).abs() < 1e-12);
        let (dark, light) = (image(16, 16, |_| 0.25), image(16, 16, |_| 0.75));
        let formula = (2.0 * 0.25 * 0.75 + 1e-4) / (0.25f64.powi(2) + 0.75f64.powi(2) + 1e-4);
        assert!((ssim(&dark, &light, Part::inside(0)).unwrap() - formula).abs() < 1e-9);
        let inverted = image(24, 20, |index| 1.0 - wave(index));
        assert!(ssim(&inverted, &expected, Part::inside(0)).unwrap() < 0.0);
        assert_eq!(ssim(&dark, &light, Part::inside(3)), None);
    }

    #[test]
    fn gradient_energy_of_a_step() {
        let step = image(6, 4, |index| if index % 6 < 3 { 0.0 } else { 0.5 });
        assert_eq!(gradient_energy(&step, 0..6, 0..4), 3.0 * 4.0 * 0.25);
        assert_eq!(gradient_energy(&step, 0..3, 0..4), 0.0);
    }

    /// A target of three planes that swings by `swing` around a constant.
    fn stack(swing: f32) -> Vec<LinearImage> {
        [-1.0, 0.0, 1.0]
            .into_iter()
            .map(|plane| image(10, 10, |index| wave(index) * 0.5 + 0.2 + swing * plane * wave(3 * index)))
            .collect()
    }

    fn score(actual: &[LinearImage], expected: &[LinearImage]) -> StackScore {
        let focuses = [0.0, 1.0, 2.5].map(Dioptres);
        let pupil = PupilDiameter::from_mm(4.0);
        score_stack(actual, expected, &focuses, &[0.0; 100], &DisplayGeometry::DEFAULT, pupil, Part::inside(1))
    }

    #[test]
    fn a_flat_stack_has_no_focus_and_scores_as_the_flat_oracle() {
        let (target, flat) = (stack(0.1), stack(0.0));
        let flat_score = score(&flat, &target);
        let response = |score: &StackScore| (score.focus_slope.unwrap(), score.focus_correlation.unwrap());
        let (slope, correlation) = response(&flat_score);
        assert!(slope.abs() < 1e-6 && correlation.abs() < 1e-6);
        assert!((flat_score.psnr_db - flat_score.flat_oracle_psnr_db).abs() < 1e-3);
        assert_eq!(flat_score.in_focus_psnr_db.unwrap(), psnr_db(&flat[0], &target[0], Part::inside(1)));
        let perfect = score(&target, &target);
        let (slope, correlation) = response(&perfect);
        assert!((slope - 1.0).abs() < 1e-9 && (correlation - 1.0).abs() < 1e-9);
        assert_eq!((perfect.psnr_db, perfect.ssim), (f64::INFINITY, None));
    }

    #[test]
    fn a_stacks_psnr_and_ssim_are_over_all_its_planes() {
        let expected = [image(24, 20, wave), image(24, 20, |index| 0.5 * wave(index))];
        let brighter = [image(24, 20, |index| wave(index) + 0.02), expected[1].clone()];
        assert!((stack_psnr_db(&brighter, &expected, Part::inside(1)) - 10.0 * (2.0 / 4e-4f64).log10()).abs() < 1e-3);
        let (depth, pupil) = ([0.0; 480], PupilDiameter::from_mm(3.0));
        let focuses = [0.0, 2.0].map(Dioptres);
        let judged =
            score_stack(&brighter, &expected, &focuses, &depth, &DisplayGeometry::DEFAULT, pupil, Part::inside(1));
        assert!((judged.psnr_db - stack_psnr_db(&brighter, &expected, Part::inside(1))).abs() < 1e-9);
        let mean = 0.5 * (ssim(&brighter[0], &expected[0], Part::inside(1)).unwrap() + 1.0);
        assert!((judged.ssim.unwrap() - mean).abs() < 1e-12 && mean < 0.9999);
    }

    #[test]
    fn colours_that_do_not_count_change_no_figure() {
        let size = Resolution { width: 96, height: 80 };
        let wavy = |scale: f32| image(size.width, size.height, |index| scale * wave(index));
        let (target, seen) = ([wavy(1.0), wavy(0.8)], [wavy(0.95), wavy(0.9)]);
        // Near enough that all is out of focus through a wide pupil.
        let (depth, pupil) = (vec![1.0; size.pixels()], PupilDiameter::from_mm(8.0));
        let focuses = [0.0, 0.5].map(Dioptres);
        let judged = |seen: &[LinearImage], target: &[LinearImage], colours: &[Colour]| {
            let part = Part { colours, border_px: 2 };
            score_stack(seen, target, &focuses, &depth, &DisplayGeometry::DEFAULT, pupil, part)
        };
        let painted = |stack: &[LinearImage; 2], colour: Colour, light: f32| {
            stack.clone().map(|mut picture| {
                picture.plane_mut(colour).fill(light);
                picture
            })
        };
        let green = judged(&seen, &target, &[Colour::Green]);
        let in_all = judged(&seen, &target, &Colour::ALL);
        assert!(green.foam.is_some() && green.ssim.is_some() && green.psnr_db.is_finite(), "{green:?}");
        assert_ne!(green, in_all);
        let dark = painted(&painted(&seen, Colour::Red, 0.0), Colour::Blue, 0.0);
        assert_eq!(judged(&dark, &target, &[Colour::Green]), green);
        assert_ne!(judged(&dark, &target, &Colour::ALL), in_all);
        let other = painted(&seen, Colour::Green, 0.5);
        assert_ne!(judged(&other, &target, &[Colour::Green]), green, "the comparison is blind");
        // Three colours alike are as one of them.
        let grey = |stack: &[LinearImage; 2]| {
            stack.clone().map(|mut picture| {
                let plane = picture.plane(Colour::Green).to_vec();
                Colour::ALL.iter().for_each(|&colour| picture.plane_mut(colour).copy_from_slice(&plane));
                picture
            })
        };
        let (of_three, of_one) = (judged(&grey(&seen), &grey(&target), &Colour::ALL), green);
        let close = |a: Option<f64>, b: Option<f64>| (a.unwrap() - b.unwrap()).abs() < 1e-9;
        assert!(close(Some(of_three.psnr_db), Some(of_one.psnr_db)) && close(of_three.ssim, of_one.ssim));
        assert!(close(of_three.foam, of_one.foam) && close(of_three.focus_slope, of_one.focus_slope));
    }

    #[test]
    fn half_the_swing_is_half_the_slope() {
        let half = score(&stack(0.05), &stack(0.1));
        assert!((half.focus_slope.unwrap() - 0.5).abs() < 1e-4);
        assert!((half.focus_correlation.unwrap() - 1.0).abs() < 1e-4);
        let unchanging = score(&stack(0.05), &stack(0.0));
        assert_eq!((unchanging.focus_slope, unchanging.focus_correlation), (None, None));
    }
}

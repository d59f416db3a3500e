//! Small logs with the layout of real ones, of a pupil that is known.

use std::f64::consts::{PI, TAU};
use std::fmt::Write;

/// Length of every log, seconds.
pub(crate) const LENGTH_S: f64 = 10.0;
/// Begin of each blink, seconds after the log's; each lasts 0.15 s.
pub(crate) const BLINKS_S: [f64; 3] = [2.0, 5.0, 8.3];

/// The pupil: 4 mm, breathing by 0.3 mm; None in a blink.
pub(crate) fn diameter_mm(t_s: f64) -> Option<f64> {
    let blinks = BLINKS_S.iter().any(|begin_s| (*begin_s..begin_s + 0.15).contains(&t_s));
    (!blinks).then(|| 4.0 + 0.3 * (TAU * 0.4 * t_s).sin())
}

fn instants(rate_hz: f64) -> impl Iterator<Item = f64> {
    (0..(LENGTH_S * rate_hz).round() as u32).map(move |k| f64::from(k) / rate_hz)
}

/// Core `pupil_positions.csv`: both eyes with 2-D rows, and 3-D rows where `model`; 10 pixels a millimetre.
pub(crate) fn core(rate_hz: f64, model: bool) -> String {
    let mut csv = String::from(
        "pupil_timestamp,world_index,eye_id,confidence,norm_pos_x,norm_pos_y,diameter,method,ellipse_center_x,\
         ellipse_center_y,ellipse_axis_a,ellipse_axis_b,ellipse_angle,diameter_3d,model_confidence,model_id,\
         sphere_center_x,sphere_center_y,sphere_center_z,sphere_radius,circle_3d_center_x,circle_3d_center_y,\
         circle_3d_center_z,circle_3d_normal_x,circle_3d_normal_y,circle_3d_normal_z,circle_3d_radius,theta,phi,\
         projected_sphere_center_x,projected_sphere_center_y,projected_sphere_axis_a,projected_sphere_axis_b,\
         projected_sphere_angle\n",
    );
    let tail = ",0.85,0,0.1,2.5,40.2,10.39,1.2,-3.1,31.0,0.1,-0.5,-0.8,1.9,2.1,-1.7,98.0,101.2,103.0,103.0,0.0";
    for (row, t_s) in instants(rate_hz).enumerate() {
        for eye in [0, 1] {
            // The cameras run free of each other; eye 1 is written first though it is later.
            let (eye, t_s) = (1 - eye, t_s + 0.003 * f64::from(1 - eye));
            let t = t_s - 323_801.6;
            let (confidence, mm) = match diameter_mm(t_s) {
                Some(mm) => (0.98, mm),
                None => (0.2, if row % 2 == 0 { -0.1 } else { 16.66 }),
            };
            let px = 10.0 * diameter_mm(t_s).unwrap_or(1.0);
            let start = format!("{t:.6},{},{eye},{confidence},0.5,0.5,{px:.4}", row / 4);
            let ellipse = "96.1,97.2,30.1,31.2,88.0";
            writeln!(csv, "{start},2d c++,{ellipse},{}", ",".repeat(20)).expect("a String takes all");
            if model {
                writeln!(csv, "{start},pye3d 0.3.0 real-time,{ellipse},{mm:.6}{tail}").expect("a String takes all");
            }
        }
    }
    csv
}

/// EyeLink `.asc` of the eyes `L`, `R` or `LR`, 100 units of diameter a millimetre.
pub(crate) fn eyelink(rate_hz: f64, eyes: &str, area: bool) -> String {
    let names: Vec<_> = eyes.chars().map(|eye| if eye == 'L' { "LEFT" } else { "RIGHT" }).collect();
    let names = names.join("\t");
    let measure = if area { "AREA" } else { "DIAMETER" };
    let mut asc = format!(
        "** CONVERTED FROM made-up.edf using edfapi 4.2.1\n** TYPE: EDF_FILE BINARY EVENT SAMPLE TAGGED\n\
         ** VERSION: EYELINK II 1\n**\n\nMSG\t999000 !CAL\n>>>>>>> CALIBRATION (HV9,P-CR) FOR LEFT: <<<<<<<<<\n\
         \t  -63     7   -44     4\n     -0  187.55  7.0443  0.53469  0.55406\nINPUT\t999500\t0\n\
         START\t1000000 \t{names}\tSAMPLES\tEVENTS\nPRESCALER\t1\nVPRESCALER\t1\nPUPIL\t{measure}\n\
         EVENTS\tGAZE\t{names}\tRATE\t{rate_hz:.2}\tTRACKING\tCR\tFILTER\t2\n\
         SAMPLES\tGAZE\t{names}\tRATE\t{rate_hz:.2}\tTRACKING\tCR\tFILTER\t2\n\
         MSG\t1000000 !MODE RECORD CR {rate_hz:.0} 2 1 {eyes}\n"
    );
    let places = usize::from(rate_hz > 1000.0);
    let mut shut_since_ms = None;
    for t_s in instants(rate_hz) {
        let t_ms = 1_000_000.0 + 1e3 * t_s;
        match (diameter_mm(t_s), shut_since_ms) {
            (None, None) => {
                shut_since_ms = Some(t_ms);
                eyes.chars().for_each(|eye| writeln!(asc, "SBLINK {eye} {t_ms:.places$}").expect("a String takes all"));
            }
            (Some(_), Some(begin)) => {
                shut_since_ms = None;
                let (end, length) = (t_ms - 1e3 / rate_hz, t_ms - begin);
                for eye in eyes.chars() {
                    writeln!(asc, "EBLINK {eye} {begin:.places$}\t{end:.places$}\t{length:.places$}")
                        .expect("a String takes all");
                }
            }
            _ => {}
        }
        write!(asc, "{t_ms:.places$}").expect("a String takes all");
        for _ in eyes.chars() {
            let figure = diameter_mm(t_s).map(|mm| if area { PI * (50.0 * mm).powi(2) } else { 100.0 * mm });
            match figure {
                Some(figure) => write!(asc, "\t  964.3\t  541.5\t {figure:.1}").expect("a String takes all"),
                None => asc.push_str("\t   .\t   .\t    0.0"),
            }
        }
        writeln!(asc, "\t{}", ".".repeat(1 + 2 * eyes.len())).expect("a String takes all");
    }
    asc.push_str("END\t1010000 \tSAMPLES\tEVENTS\tRES\t  47.75\t  45.92\n");
    asc
}

/// SMI BeGaze text with messages in between and a low sample on each side of a blink.
pub(crate) fn smi(rate_hz: f64, separator: char, decimal_comma: bool) -> String {
    let names = ["Time", "Type", "Trial", "L Pupil Diameter [mm]", "R Pupil Diameter [mm]", "L Event Info"];
    let mut text = format!(
        "## [BeGaze]\r\n## Version:\tBeGaze 3.4\r\n## Sample Rate:\t{rate_hz:.0}\r\n##\r\n{}\r\n",
        names.join(&separator.to_string())
    );
    for (row, t_s) in instants(rate_hz).enumerate() {
        let jitter_us = [0, 60, -50, 0][row % 4];
        let t_us = 8_412_345_678 + jitter_us + (1e6 * t_s).round() as i64;
        if row % 100 == 7 {
            writeln!(text, "{t_us}{separator}MSG{separator}1{separator}# Message: picture_{row}.jpg\r")
                .expect("a String takes all");
        }
        let near = |t_s: f64| diameter_mm(t_s).is_none();
        let edge = near(t_s - 1.0 / rate_hz) || near(t_s + 1.0 / rate_hz);
        let (mm, event) = match diameter_mm(t_s) {
            None => ("0.00".into(), "Blink"),
            Some(mm) => (format!("{:.2}", if edge { 0.6 * mm } else { mm }), "Fixation"),
        };
        let mm = if decimal_comma { mm.replace('.', ",") } else { mm };
        let cells = [&t_us.to_string(), "SMP", "1", &mm, &mm, event];
        writeln!(text, "{}\r", cells.join(&separator.to_string())).expect("a String takes all");
    }
    text
}

/// Neon `eye_state ps1.raw` and its `.time`; only the lids' distance shows a blink.
pub(crate) fn neon_native(rate_hz: f64) -> (Vec<u8>, Vec<u8>) {
    let (mut states, mut times) = (Vec::new(), Vec::new());
    for t_s in instants(rate_hz) {
        let mm = diameter_mm(t_s).unwrap_or(3.9) as f32;
        let lids = if diameter_mm(t_s).is_some() { 7.0 } else { 0.1 };
        let eye = [mm, -30.0, 11.7, -34.2, -0.1, 0.25, 0.963];
        let eyelids = [-0.08, -0.68, lids];
        states.extend([&eye[..], &eye[..], &eyelids[..], &eyelids[..]].concat().into_iter().flat_map(f32::to_le_bytes));
        times.extend((1_760_676_790_465_965_534 + (1e9 * t_s).round() as i64).to_le_bytes());
    }
    (states, times)
}

//! `holod pattern`: test patterns as pictures, in words, and on the panel.

mod show;
mod sight;

use std::path::{Path, PathBuf};

use holod_calibration::Colour;
use holod_slm_output::patterns::{Pattern, Placement};
use holod_slm_output::{FrameLayout, LevelsFrame, OutputSpec, PanelEncoder};
use serde::Serialize;

use self::show::Shown;
use self::sight::Sight;
use crate::cli::{PatternKind, PatternTarget};
use crate::failure::{Exit, Failure};
use crate::overwriting::refuse_existing;
use crate::pictures::video_pictures;
use crate::session::{NO_ACKNOWLEDGEMENT, not_dark};
use crate::{results, setup};

/// What `--json` prints, once the pattern is no longer shown.
#[derive(Serialize)]
struct Report<'a> {
    #[serde(flatten)]
    sight: &'a Sight,
    /// What was shown on a panel; none without `--output`.
    shown: Option<&'a Shown>,
}

pub(super) fn pattern(kind: &PatternKind<PatternTarget>) -> Result<(), Failure> {
    let to = kind.target();
    let output =
        to.output.as_deref().map(str::parse::<OutputSpec>).transpose().map_err(Failure::because(Exit::Usage))?;
    let rig = setup::rig(&to.rig)?;
    setup::warn_of_panel(&rig);
    let resolution = rig.resolution();
    let encoder = PanelEncoder::new(&rig.panel, resolution, resolution).map_err(Failure::because(Exit::Config))?;
    let pattern = Pattern::from(kind);
    let placement = Placement::new(to.place.axis, &to.place.colour);
    let mut levels = LevelsFrame::new(FrameLayout::new(&rig.panel, resolution));
    let usage = Failure::because(Exit::Usage);
    pattern.draw(&placement, &encoder, &rig.geometry, &mut levels).map_err(&usage)?;
    let mut sight = Sight::of(&pattern, &placement, &rig, &encoder).map_err(usage)?;
    if let Some(out) = &to.out {
        sight.files = save(&levels, out, to.force)?;
    }
    if !to.json {
        results::print(sight.to_string().trim_end())?;
    }
    let Some(output) = output else {
        return if to.json { results::print_json(&Report { sight: &sight, shown: None }) } else { Ok(()) };
    };
    if to.rig.config.is_none() && !matches!(output, OutputSpec::Headless(_)) {
        tracing::warn!("no --config: this is the built-in rig's panel and optics, and it lights no lasers");
    }
    let lit = show::rig_with_lasers_of(rig, &placement);
    let shown = show::show(&output, &lit, &encoder, &levels, to)?;
    if to.json {
        results::print_json(&Report { sight: &sight, shown: Some(&shown) })?;
    } else {
        results::print(&shown.to_string())?;
    }
    match shown.lasers_dark {
        true => Ok(()),
        false => Err(Failure::new(Exit::Unavailable, not_dark(NO_ACKNOWLEDGEMENT))),
    }
}

/// Writes each video frame that carries `levels`: to `out`, or to a file beside it for each field.
fn save(levels: &LevelsFrame, out: &Path, force: bool) -> Result<Vec<PathBuf>, Failure> {
    if out.is_dir() || out.file_stem().is_none() || out == Path::new("-") {
        return Err(Failure::new(
            Exit::CannotCreate,
            format!("--out {}: expected the name of a PNG file to write", out.display()),
        ));
    }
    if let Some(found) = out.extension().filter(|extension| !extension.eq_ignore_ascii_case("png")) {
        let found = found.display();
        return Err(Failure::new(Exit::Usage, format!("--out: found a file of kind .{found}; expected FILE.png")));
    }
    let pictures = video_pictures(levels);
    let single = pictures.len() == 1;
    let name = |position: usize, colour: Option<Colour>| match colour {
        Some(colour) if !single => {
            let stem = out.file_stem().unwrap_or_default().to_string_lossy();
            out.with_file_name(format!("{stem}-{}-{colour}.png", position + 1))
        }
        _ => out.to_path_buf(),
    };
    let files: Vec<PathBuf> =
        pictures.iter().enumerate().map(|(position, (colour, _))| name(position, *colour)).collect();
    refuse_existing(files.iter().cloned(), "--out", force)?;
    for ((_, picture), file) in pictures.into_iter().zip(&files) {
        results::save_png(picture, file)?;
    }
    Ok(files)
}

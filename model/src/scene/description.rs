//! What a scene is made of: `scene.toml`, a pair of files, or one OpenEXR file.

use std::io;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use toml::Spanned;

use super::depth::DepthReading;
use super::{DepthEncoding, SceneError, raster};
use crate::whole_file::{self, Unread};

/// Scene files are small; a larger one is something else.
const LARGEST_FILE_BYTES: u64 = 1 << 20;
/// A day at 120 frames a second.
const MOST_FRAMES: u64 = 24 * 3600 * 120;

/// The files of a scene and how to read them.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Description {
    /// The scene as it was named, for errors.
    pub(super) path: PathBuf,
    pub(super) colour: FilePattern,
    pub(super) depth: FilePattern,
    pub(super) depth_reading: DepthReading,
    pub(super) frames: usize,
    pub(super) first: u64,
    pub(super) step: u64,
    pub(super) fps: Option<f64>,
    /// The line of a scene file at which a sequence begins, from 1.
    pub(super) sequence_line: usize,
}

/// A path in which `{}` or `{:05}` stands for the number of a frame.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct FilePattern {
    before: String,
    /// Least digits of the number, where there is one.
    digits: Option<usize>,
    after: String,
    directory: PathBuf,
}

impl FilePattern {
    /// `None` where the braces are not a number's.
    fn parse(text: &str, directory: &Path) -> Option<Self> {
        let pattern = |before: &str, digits, after: &str| Self {
            before: before.into(),
            digits,
            after: after.into(),
            directory: directory.to_owned(),
        };
        let Some((before, rest)) = text.split_once('{') else {
            return (!text.contains('}')).then(|| pattern(text, None, ""));
        };
        let (format, after) = rest.split_once('}')?;
        if after.contains(['{', '}']) {
            return None;
        }
        let digits = match format {
            "" => 1,
            _ => format.strip_prefix(':')?.parse().ok().filter(|digits| (1..=20).contains(digits))?,
        };
        Some(pattern(before, Some(digits), after))
    }

    /// A file that is named literally, whatever characters its name has.
    fn literal(path: &Path) -> Option<Self> {
        Some(Self { before: path.to_str()?.into(), digits: None, after: String::new(), directory: PathBuf::new() })
    }

    fn numbered(&self) -> bool {
        self.digits.is_some()
    }

    /// The greatest number that is not below `least`, of the frames from `first` on in steps of `step`, which has a file.
    fn greatest(&self, least: u64, first: u64, step: u64) -> Option<u64> {
        self.digits?;
        let (folder, name) = self.before.rsplit_once('/').unwrap_or(("", &self.before));
        let after = self.after.split('/').next().unwrap_or_default();
        let number = |entry: std::io::Result<std::fs::DirEntry>| -> Option<u64> {
            let found = entry.ok()?.file_name();
            let number: u64 = found.to_str()?.strip_prefix(name)?.strip_suffix(after)?.parse().ok()?;
            let is_one = number >= least && (number - first).is_multiple_of(step) && self.path(number).exists();
            is_one.then_some(number)
        };
        let root = if self.before.starts_with('/') { Path::new("/") } else { &self.directory };
        // An empty folder's name is the current folder.
        std::fs::read_dir(Path::new(".").join(root).join(folder)).ok()?.filter_map(number).max()
    }

    /// The file of frame number `number`.
    pub(super) fn path(&self, number: u64) -> PathBuf {
        let Self { before, digits, after, directory } = self;
        directory.join(match digits {
            None => before.clone(),
            Some(digits) => format!("{before}{number:0digits$}{after}"),
        })
    }
}

/// The keys of a `scene.toml`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SceneFile {
    colour: Spanned<String>,
    depth: Option<Spanned<String>>,
    depth_encoding: Spanned<String>,
    far_dpt: Option<Spanned<f64>>,
    near_dpt: Option<Spanned<f64>>,
    depth_scale: Option<Spanned<f64>>,
    depth_missing: Option<f64>,
    first: Option<Spanned<u64>>,
    step: Option<Spanned<u64>>,
    count: Option<Spanned<u64>>,
    fps: Option<Spanned<f64>>,
}

/// The scene that `spec` names; see [`super::Scene::open`].
pub(super) fn describe(spec: &str, encoding: Option<DepthEncoding>) -> Result<Description, SceneError> {
    let path = Path::new(spec);
    if path.is_dir() {
        return read_scene_file(&path.join("scene.toml"), encoding);
    }
    if path.extension().is_some_and(|extension| extension == "toml") {
        return read_scene_file(path, encoding);
    }
    let pair = if path.exists() { None } else { pair(spec)? };
    let (colour, depth) = pair.map_or((path, path), |(colour, depth)| (Path::new(colour), Path::new(depth)));
    if pair.is_none() {
        single_file(path)?;
    }
    let encoding =
        encoding.ok_or_else(|| SceneError::DepthEncoding { found: "none for a scene of plain files".into() })?;
    let literal = |path: &Path| {
        FilePattern::literal(path).ok_or_else(|| SceneError::Kind {
            path: path.to_owned(),
            found: "a name that is not UTF-8".into(),
            expected: "a UTF-8 name: rename the file",
        })
    };
    Ok(Description {
        path: path.to_owned(),
        colour: literal(colour)?,
        depth: literal(depth)?,
        depth_reading: DepthReading { encoding, scale: None, missing: None },
        frames: 1,
        first: 0,
        step: 1,
        fps: None,
        sequence_line: 1,
    })
}

/// The two files of COLOUR,DEPTH. Of several commas it is the one beside which there are two files.
fn pair(spec: &str) -> Result<Option<(&str, &str)>, SceneError> {
    let parted: Vec<_> = spec.match_indices(',').map(|(at, _)| (&spec[..at], &spec[at + 1..])).collect();
    if parted.len() < 2 {
        return Ok(parted.first().copied());
    }
    let are_there = |(colour, depth): &&(&str, &str)| Path::new(colour).is_file() && Path::new(depth).is_file();
    let there: Vec<_> = parted.iter().filter(are_there).collect();
    match there[..] {
        [one] => Ok(Some(*one)),
        _ => Err(SceneError::Kind {
            path: spec.into(),
            found: format!("{} commas, beside {} of which there are two files", parted.len(), there.len()),
            expected: "COLOUR,DEPTH: correct the names, or name files with a comma in a scene.toml",
        }),
    }
}

/// What a scene can be, for errors.
const KINDS: &str = "a directory with a scene.toml, COLOUR,DEPTH, or one OpenEXR file with colour and depth";

/// Checks that `path` can be one file with both colour and depth.
fn single_file(path: &Path) -> Result<(), SceneError> {
    std::fs::metadata(path).map_err(|source| SceneError::Read { path: path.to_owned(), source, expected: KINDS })?;
    // What is called one and is none is damaged, which its reader says.
    let is_called_exr = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("exr"));
    if is_called_exr || raster::is_openexr(path)? {
        return Ok(());
    }
    Err(SceneError::Kind { path: path.to_owned(), found: "one file that is not OpenEXR".into(), expected: KINDS })
}

fn read_scene_file(path: &Path, named: Option<DepthEncoding>) -> Result<Description, SceneError> {
    parse(path, &read_text(path, "a scene.toml of at most 1 MiB")?, named)
}

/// The text of a file that describes pictures.
pub(super) fn read_text(path: &Path, expected: &'static str) -> Result<String, SceneError> {
    let read_error = |source| SceneError::Read { path: path.to_owned(), source, expected };
    let bytes = whole_file::read(path, LARGEST_FILE_BYTES).map_err(|unread| match unread {
        Unread::NoFile { found } => SceneError::Kind { path: path.to_owned(), found, expected },
        Unread::System(source) => read_error(source),
    })?;
    String::from_utf8(bytes).map_err(|error| read_error(io::Error::new(io::ErrorKind::InvalidData, error.utf8_error())))
}

/// What is wrong at `offset` of the text of such a file.
pub(super) fn line_error(
    path: &Path,
    text: &str,
    offset: usize,
    key: &str,
    found: String,
    expected: &str,
) -> SceneError {
    SceneError::Description {
        path: path.to_owned(),
        line: line_at(text, offset),
        key: key.into(),
        found,
        expected: expected.into(),
    }
}

/// The line at `offset` of `text`, from 1.
fn line_at(text: &str, offset: usize) -> usize {
    text[..offset.min(text.len())].matches('\n').count() + 1
}

/// Reads a scene file, beside which `named` was named.
fn parse(path: &Path, text: &str, named: Option<DepthEncoding>) -> Result<Description, SceneError> {
    let source = Source { path, text };
    let file = source.keys()?;
    let encoding = source.depth_encoding(&file, named)?;
    source.check_numbers(&file)?;
    let colour = source.pattern("colour", &file.colour)?;
    let depth = match &file.depth {
        Some(depth) => source.pattern("depth", depth)?,
        None => colour.clone(),
    };
    let numbered_key = file.depth.as_ref().filter(|_| !colour.numbered()).unwrap_or(&file.colour);
    let first = file.first.as_ref().map_or(0, |first| *first.get_ref());
    let step = file.step.as_ref().map_or(1, |step| *step.get_ref());
    let numbered = [&colour, &depth].into_iter().any(FilePattern::numbered);
    let frames = match &file.count {
        Some(count) => source.given_count(count, numbered)?,
        None if numbered => source.frames_there([&colour, &depth], first, step, numbered_key)?,
        None => 1,
    };
    source.check_last(&file, frames, first, step)?;
    Ok(Description {
        path: path.to_owned(),
        colour,
        depth,
        depth_reading: DepthReading {
            encoding,
            scale: file.depth_scale.map(Spanned::into_inner),
            missing: file.depth_missing,
        },
        frames: frames as usize,
        first,
        step,
        sequence_line: source.line(numbered_key),
        fps: file.fps.map(Spanned::into_inner),
    })
}

/// A scene file's text, for errors that say where in it.
struct Source<'a> {
    path: &'a Path,
    text: &'a str,
}

impl Source<'_> {
    fn error<T>(&self, at: &Spanned<T>, key: &str, found: String, expected: &str) -> SceneError {
        line_error(self.path, self.text, at.span().start, key, found, expected)
    }

    fn line<T>(&self, at: &Spanned<T>) -> usize {
        line_at(self.text, at.span().start)
    }

    fn keys(&self) -> Result<SceneFile, SceneError> {
        toml::from_str(self.text).map_err(|error| {
            let span = error.span().unwrap_or_default();
            let key = self.text.get(span.clone());
            let key = key.filter(|key| !key.is_empty() && key.len() < 60 && !key.contains('\n')).unwrap_or("scene");
            line_error(self.path, self.text, span.start, key, error.message().to_string(), KEYS)
        })
    }

    /// What depths are written as, and that `named` is no other.
    fn depth_encoding(&self, file: &SceneFile, named: Option<DepthEncoding>) -> Result<DepthEncoding, SceneError> {
        let name = file.depth_encoding.get_ref().as_str();
        let own = match name {
            "metres" => DepthEncoding::Metres,
            "millimetres" => DepthEncoding::Millimetres,
            "dioptres" => DepthEncoding::Dioptres,
            "normalised_dioptres" => self.normalised_dioptres(file)?,
            other => {
                let expected = "metres, millimetres, dioptres or normalised_dioptres (with near_dpt and far_dpt)";
                return Err(self.error(&file.depth_encoding, "depth_encoding", format!("\"{other}\""), expected));
            }
        };
        let bounds = [("near_dpt", &file.near_dpt), ("far_dpt", &file.far_dpt)];
        if !matches!(own, DepthEncoding::NormalisedDioptres { .. })
            && let Some((key, bound)) = bounds.into_iter().find_map(|(key, bound)| Some((key, bound.as_ref()?)))
        {
            let found = format!("{} with depth_encoding \"{name}\"", bound.get_ref());
            return Err(self.error(bound, key, found, "it only with normalised_dioptres"));
        }
        match named.filter(|named| *named != own) {
            None => Ok(own),
            Some(named) => {
                let line = self.line(&file.depth_encoding);
                Err(SceneError::EncodingsDiffer { path: self.path.to_owned(), line, own, named })
            }
        }
    }

    fn normalised_dioptres(&self, file: &SceneFile) -> Result<DepthEncoding, SceneError> {
        let (Some(near), Some(far)) = (&file.near_dpt, &file.far_dpt) else {
            let found = "normalised_dioptres without both near_dpt and far_dpt".into();
            let expected = "the vergences of 1 and 0 in dioptres";
            return Err(self.error(&file.depth_encoding, "depth_encoding", found, expected));
        };
        let (near_dpt, far_dpt) = (*near.get_ref(), *far.get_ref());
        if !(far_dpt >= 0.0 && near_dpt > far_dpt && near_dpt.is_finite()) {
            let found = format!("{near_dpt} with far_dpt {far_dpt}");
            return Err(self.error(near, "near_dpt", found, "more dioptres than far_dpt, which is at least 0"));
        }
        Ok(DepthEncoding::NormalisedDioptres { far_dpt, near_dpt })
    }

    fn check_numbers(&self, file: &SceneFile) -> Result<(), SceneError> {
        for (key, value) in [("depth_scale", &file.depth_scale), ("fps", &file.fps)] {
            if let Some(value) = value
                && !(*value.get_ref() > 0.0 && value.get_ref().is_finite())
            {
                return Err(self.error(value, key, value.get_ref().to_string(), "a positive number"));
            }
        }
        match &file.step {
            Some(step) if *step.get_ref() == 0 => Err(self.error(step, "step", "0".into(), "at least 1")),
            _ => Ok(()),
        }
    }

    fn pattern(&self, key: &str, text: &Spanned<String>) -> Result<FilePattern, SceneError> {
        let directory = self.path.parent().unwrap_or(Path::new(""));
        FilePattern::parse(text.get_ref(), directory).ok_or_else(|| {
            let expected = "a file name, with at most one {} or {:05} for the frame's number";
            self.error(text, key, format!("\"{}\"", text.get_ref()), expected)
        })
    }

    /// The number of frames that the file names.
    fn given_count(&self, count: &Spanned<u64>, numbered: bool) -> Result<u64, SceneError> {
        let frames = *count.get_ref();
        let refused = |expected: &str| Err(self.error(count, "count", frames.to_string(), expected));
        match frames {
            1..=MOST_FRAMES if frames == 1 || numbered => Ok(frames),
            1..=MOST_FRAMES => refused("1, or a {} for the frame's number in colour or depth"),
            _ => refused(&format!("1 to {MOST_FRAMES}")),
        }
    }

    /// The number of frames that have files, from `first` on without a gap.
    fn frames_there(
        &self,
        files: [&FilePattern; 2],
        first: u64,
        step: u64,
        key: &Spanned<String>,
    ) -> Result<u64, SceneError> {
        let number = |index: u64| first.saturating_add(index.saturating_mul(step));
        let is_there = |&index: &u64| files.iter().all(|files| files.path(number(index)).exists());
        let frames = (0..MOST_FRAMES).take_while(is_there).count() as u64;
        let missing = number(frames);
        let Some(greatest) = files.iter().filter_map(|files| files.greatest(missing, first, step)).max() else {
            // A sequence without its first frame is reported when that is loaded.
            return Ok(frames.max(1));
        };
        let paths = files.map(|files| files.path(missing));
        let path = paths.iter().find(|path| !path.exists()).unwrap_or(&paths[0]);
        let found = format!("none, and {} is missing where files go on to number {greatest}", path.display());
        let cure = match frames {
            0 => "the number of the first frame as `first`".into(),
            _ => format!("`count = {frames}` for the frames before it alone"),
        };
        let expected = format!("a file for each number: supply it, or write {cure}");
        Err(self.error(key, "count", found, &expected))
    }

    /// Refuses frames whose last number is too large.
    fn check_last(&self, file: &SceneFile, frames: u64, first: u64, step: u64) -> Result<(), SceneError> {
        if (frames - 1).checked_mul(step).and_then(|distance| first.checked_add(distance)).is_some() {
            return Ok(());
        }
        // The largest of them, most likely, is the one that is not meant.
        let keys = [("first", &file.first), ("step", &file.step), ("count", &file.count)];
        let given = keys.into_iter().filter_map(|(key, value)| Some((key, value.as_ref()?)));
        let (key, value) = given.max_by_key(|(_, value)| *value.get_ref()).expect("nothing overflows by itself");
        let found = format!("{} for the {frames} frames {first}, {first} + {step} and so on", value.get_ref());
        Err(self.error(value, key, found, "frame numbers below 2^64"))
    }
}

/// What a scene file can say, for errors.
const KEYS: &str = "TOML with colour, depth and depth_encoding, and where they apply near_dpt, far_dpt, depth_scale, \
                    depth_missing, first, step, count and fps";

#[cfg(test)]
mod tests {
    use super::*;

    fn parse_text(text: &str) -> Result<Description, SceneError> {
        parse(Path::new("somewhere/scene.toml"), text, None)
    }

    fn assert_refused(text: &str, line: usize, parts: &[&str]) {
        let message = parse_text(text).unwrap_err().to_string();
        for part in parts.iter().copied().chain(["scene.toml", &format!("line {line}:")]) {
            assert!(message.contains(part), "`{part}` is not in: {message}");
        }
    }

    const PAIR: &str = "colour = \"c.png\"\ndepth = \"d.png\"\n";

    #[test]
    fn a_still_and_a_sequence_are_read() {
        let still = parse_text(&format!("{PAIR}depth_encoding = \"metres\"\ndepth_missing = 0")).unwrap();
        assert_eq!((still.frames, still.fps), (1, None));
        assert_eq!(still.colour.path(7), Path::new("somewhere/c.png"));
        assert_eq!(still.depth_reading.missing, Some(0.0));

        let sequence = parse_text(
            "colour = \"rgb/{:05}.jpg\"\ndepth = \"depth/{}.png\"\ndepth_encoding = \"normalised_dioptres\"\n\
             near_dpt = 2.5\nfar_dpt = 0\nfirst = 30\nstep = 30\ncount = 4\nfps = 24",
        )
        .unwrap();
        assert_eq!((sequence.frames, sequence.first, sequence.step, sequence.fps), (4, 30, 30, Some(24.0)));
        assert_eq!(sequence.colour.path(30), Path::new("somewhere/rgb/00030.jpg"));
        assert_eq!(sequence.depth.path(30), Path::new("somewhere/depth/30.png"));
        let encoding = DepthEncoding::NormalisedDioptres { far_dpt: 0.0, near_dpt: 2.5 };
        assert_eq!(sequence.depth_reading.encoding, encoding);
    }

    #[test]
    fn faults_name_the_key_and_the_line() {
        let encoded = |rest: &str| format!("{PAIR}depth_encoding = \"metres\"\n{rest}");
        assert_refused(&encoded("colr = 3"), 4, &["colr"]);
        assert_refused(PAIR, 1, &["depth_encoding"]);
        assert_refused(
            &format!("{PAIR}\ndepth_encoding = \"inches\""),
            4,
            &["`depth_encoding`", "inches", "millimetres", "dioptres"],
        );
        assert_refused(&format!("{PAIR}depth_encoding = \"normalised_dioptres\"\nnear_dpt = 2"), 3, &["far_dpt"]);
        assert_refused(
            &format!("{PAIR}depth_encoding = \"normalised_dioptres\"\nnear_dpt = 1\nfar_dpt = 2"),
            4,
            &["`near_dpt`"],
        );
        assert_refused(&encoded("near_dpt = 2.0"), 4, &["`near_dpt`", "normalised_dioptres"]);
        assert_refused(&encoded("depth_scale = -1"), 4, &["`depth_scale`", "-1"]);
        assert_refused(&encoded("fps = nan"), 4, &["`fps`"]);
        assert_refused(&encoded("step = 0"), 4, &["`step`"]);
        assert_refused(&encoded("count = 3"), 4, &["`count`", "{}"]);
        assert_refused(&encoded("count = 0"), 4, &["`count`"]);
        // Numbers up to 2^63 - 1 are TOML.
        let numbered = |rest: &str| encoded(rest).replace("c.png", "c{}.png");
        let large = i64::MAX;
        let says = |key| [key, "frame numbers below 2^64"];
        assert_refused(&numbered(&format!("count = 4\nstep = {large}")), 5, &says("`step`: found 9223372036854775807"));
        assert_refused(
            &numbered(&format!("first = {large}\ncount = 20000\nstep = 900000000000000")),
            4,
            &says("`first`"),
        );
        assert_refused("colour = \"{x}.png\"\ndepth_encoding = \"metres\"", 1, &["`colour`", "{x}"]);
        assert_refused("colour = ", 1, &["scene"]);
    }

    #[test]
    fn an_encoding_beside_a_scene_file_must_be_the_files_own() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("scene.toml");
        let normalised = |far_dpt, near_dpt| DepthEncoding::NormalisedDioptres { far_dpt, near_dpt };
        let bounds = "normalised_dioptres\"\nfar_dpt = 0.5\nnear_dpt = 2.5";
        for (text, own, other, said) in [
            ("metres\"", DepthEncoding::Metres, DepthEncoding::Dioptres, "found metres here and dioptres named"),
            ("millimetres\"", DepthEncoding::Millimetres, DepthEncoding::Metres, "found millimetres here and metres"),
            (
                bounds,
                normalised(0.5, 2.5),
                normalised(0.5, 2.75),
                "found normalised_dioptres:0.5,2.5 here and normalised_dioptres:0.5,2.75 named",
            ),
        ] {
            std::fs::write(&file, format!("{PAIR}depth_encoding = \"{text}")).unwrap();
            for spec in [folder.path(), file.as_path()].map(|path| path.to_str().unwrap()) {
                assert_eq!(describe(spec, Some(own)).unwrap(), describe(spec, None).unwrap());
                let error = describe(spec, Some(other)).unwrap_err().to_string();
                for part in ["scene.toml, line 3: `depth_encoding`", said, "--depth-encoding", "change it in this file"]
                {
                    assert!(error.contains(part), "`{part}` is not in: {error}");
                }
            }
        }
    }

    #[test]
    fn names_with_a_comma_are_parted_where_both_files_are() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name).display().to_string();
        let write = |name: &str| std::fs::write(at(name), b"x").unwrap();
        let described = |colour: &str, depth: &str| -> Result<_, SceneError> {
            let described = describe(&format!("{},{}", at(colour), at(depth)), Some(DepthEncoding::Metres))?;
            Ok([described.colour.path(0), described.depth.path(0)].map(|path| path.display().to_string()))
        };
        ["my,c.png", "d.png", "c.png", "the,d,.png"].into_iter().for_each(write);
        for (colour, depth) in [("my,c.png", "d.png"), ("c.png", "the,d,.png"), ("my,c.png", "the,d,.png")] {
            assert_eq!(described(colour, depth).unwrap(), [at(colour), at(depth)]);
        }
        let missing = described("my,c.png", "nowhere.png").unwrap_err().to_string();
        assert!(missing.contains("2 commas, beside 0 of which") && missing.contains("scene.toml"), "{missing}");
        // `c` and `d.png,e.png` as well as `c,d.png` and `e.png`, beside each other.
        let spec = format!("{},{},{}", at("c"), at("d.png"), at("e.png"));
        for name in
            [at("c"), format!("{},{}", at("d.png"), at("e.png")), format!("{},{}", at("c"), at("d.png")), at("e.png")]
        {
            let path = Path::new(&name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, b"x").unwrap();
        }
        let ambiguous = describe(&spec, Some(DepthEncoding::Metres)).unwrap_err().to_string();
        assert!(ambiguous.contains("2 commas, beside 2 of which"), "{ambiguous}");
    }

    #[test]
    fn plain_files_need_an_encoding() {
        let folder = tempfile::tempdir().unwrap();
        let png = folder.path().join("a.png");
        std::fs::write(&png, b"x").unwrap();
        let pair = format!("{0},{0}", png.display());
        assert!(matches!(describe(&pair, None), Err(SceneError::DepthEncoding { .. })));
        assert!(describe(&pair, Some(DepthEncoding::Metres)).is_ok());
        let exr = folder.path().join("a.hdr");
        std::fs::write(&exr, [0x76, 0x2f, 0x31, 0x01, 2]).unwrap();
        assert!(describe(exr.to_str().unwrap(), Some(DepthEncoding::Metres)).is_ok(), "known by its content");
        let single = describe(png.to_str().unwrap(), Some(DepthEncoding::Metres)).unwrap_err();
        assert!(matches!(single, SceneError::Kind { .. }), "{single}");
        let absent = describe("/no/such/scene", None).unwrap_err();
        assert!(matches!(absent, SceneError::Read { .. }), "{absent}");
        let empty = describe(folder.path().to_str().unwrap(), None).unwrap_err();
        assert!(empty.to_string().contains("scene.toml"), "{empty}");
    }
}

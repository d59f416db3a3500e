//! Lasers that take commands in text: how each kind is spoken to.

use std::path::Path;
use std::sync::LazyLock;

use super::RigError;
use super::reader::Span;
use crate::toml_reader::{self, Found, Section};

const FILES: [(&str, &str); 2] = [
    ("cobolt", include_str!("../../profiles/lasers/cobolt.toml")),
    ("coherent-obis", include_str!("../../profiles/lasers/coherent-obis.toml")),
];

static PROFILES: LazyLock<Vec<(&'static str, TextLaserProfile)>> = LazyLock::new(|| {
    FILES
        .into_iter()
        .filter_map(|(name, text)| Some((name, TextLaserProfile::parse(text, Path::new(name)).ok()?)))
        .collect()
});

const BAUD: Span = Span::new(300.0, 4_000_000.0, "baud");
const ANSWER_TIMEOUT: Span = Span::new(10.0, 5000.0, "ms").slips(&[("seconds", 1e3)]);
/// Most questions and commands of one kind.
const LIST_MAX: usize = 8;
/// Longest text of a command or an answer.
const TEXT_BYTES_MAX: usize = 80;

const LAYOUT: [(&str, &[&str]); 5] = [
    ("", &["description", "source", "unverified", "line", "identify", "healthy", "commands"]),
    ("line", &["baud", "end_of_command", "answer_timeout_ms"]),
    ("identify", &["ask", "contains", "one_of", "digits"]),
    ("healthy", &["ask", "contains", "one_of", "digits", "otherwise"]),
    ("commands", &["prepare", "power", "on", "off", "acknowledge", "error"]),
];

/// How a laser that takes commands in text is spoken to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TextLaserProfile {
    /// Maker and model, as messages name them.
    pub description: String,
    /// Rate of its serial port, baud; 8 bits, no parity, one stop bit.
    pub baud: u32,
    /// What ends a command. Answers may end with CR, LF or both.
    pub end_of_command: String,
    /// Longest time for which it may be silent before it answers, milliseconds.
    pub answer_timeout_ms: u32,
    /// What tells it from another device: harmless reads, asked before anything else is said.
    pub identify: Vec<Question>,
    /// What it must say while it is used: its interlock, its faults, the mode in which [`Self::power`] is in force.
    pub healthy: Vec<Question>,
    /// Commands, sent while it is dark, that bring it to where power alone lights nothing and [`Self::power`] is in
    /// force.
    pub prepare: Vec<String>,
    /// The command that sets its power: with `{power_w}` or `{power_mw}` in it.
    pub power: String,
    /// Commands that light it.
    pub on: Vec<String>,
    /// Commands that put it out.
    pub off: Vec<String>,
    /// How it answers a command that it has carried out.
    pub acknowledge: String,
    /// How the answer to one that it has not carried out begins.
    pub error: Option<String>,
}

/// A question and the answers that are right.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Question {
    /// The command that asks, without its line ending.
    pub ask: String,
    /// Which answers are right.
    pub expect: Expected,
    /// The command that brings the laser to where it answers like that, of a question of [`TextLaserProfile::healthy`]. It
    /// is sent like those of [`TextLaserProfile::prepare`], and only where the answer is another one.
    pub otherwise: Option<String>,
}

/// Which answers are right.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Expected {
    /// Those with this in them.
    Contains(String),
    /// Exactly one of these.
    OneOf(Vec<String>),
    /// Digits and nothing else.
    Digits,
}

impl Expected {
    /// Whether `answer` is right.
    pub fn accepts(&self, answer: &str) -> bool {
        match self {
            Self::Contains(text) => answer.contains(text.as_str()),
            Self::OneOf(texts) => texts.iter().any(|text| text == answer),
            Self::Digits => !answer.is_empty() && answer.bytes().all(|byte| byte.is_ascii_digit()),
        }
    }
}

impl TextLaserProfile {
    /// The names of the profiles that there are.
    pub fn names() -> impl Iterator<Item = &'static str> {
        PROFILES.iter().map(|(name, _)| *name)
    }

    /// The profile called `name`.
    pub fn named(name: &str) -> Option<&'static Self> {
        PROFILES.iter().find(|(known, _)| *known == name).map(|(_, profile)| profile)
    }

    /// Reads a profile's text; `origin` is for messages.
    ///
    /// # Errors
    /// [`RigError`] with every fault.
    pub fn parse(text: &str, origin: &Path) -> Result<Self, RigError> {
        toml_reader::read(text, read).map_err(|faults| RigError { origin: origin.display().to_string(), faults })
    }
}

fn read(root: &Section<'_>) -> Option<TextLaserProfile> {
    root.check_layout(&LAYOUT, &[]);
    let description = root.required_text("description", "maker and model");
    let _for_people = root.text("source", "where the commands come from");
    let [line, commands] = ["line", "commands"].map(|name| root.required_section(name));
    for section in [&line, &commands] {
        section.check_layout(&LAYOUT, &[]);
    }
    let baud = line.required_integer("baud", BAUD);
    let end_of_command = read_end_of_command(&line);
    let answer_timeout_ms = line.required_integer("answer_timeout_ms", ANSWER_TIMEOUT);
    let identify = questions(root, "identify");
    if identify.as_ref().is_some_and(Vec::is_empty) {
        let advice = "add a table [[identify]] with a harmless question, so that another device is recognised";
        root.fault_at("identify", None, "nothing", "a question that tells this laser from other devices", advice);
    }
    let healthy = questions(root, "healthy");
    let prepare = command_list(&commands, "prepare", false);
    let power = commands.required_text("power", "the command that sets the power");
    let on = command_list(&commands, "on", true);
    let off = command_list(&commands, "off", true);
    let acknowledge = commands.required_text("acknowledge", "how it answers a command");
    let error = commands.text("error", "how its complaints begin");
    if let Some(power) = &power {
        let places = power.value.matches("{power_w}").count() + power.value.matches("{power_mw}").count();
        if places != 1 {
            let advice = "write {power_w} for watts or {power_mw} for milliwatts where the figure stands";
            let found = format!("{:?}", power.value);
            power.fault(&found, "one {power_w} or {power_mw}", advice);
        }
        sendable(power);
    }
    Some(TextLaserProfile {
        description: description?.value.into(),
        baud: baud?.value as u32,
        end_of_command: end_of_command?.into(),
        answer_timeout_ms: answer_timeout_ms?.value as u32,
        identify: identify?,
        healthy: healthy?,
        prepare: prepare?,
        power: power?.value.into(),
        on: on?,
        off: off?,
        acknowledge: acknowledge?.value.into(),
        error: error.map(|error| error.value.into()),
    })
}

fn read_end_of_command<'a>(line: &Section<'a>) -> Option<&'a str> {
    const EXPECTED: &str = r#"one of "\r", "\n" and "\r\n""#;
    let found = line.require("end_of_command", EXPECTED)?;
    let end = found.raw_text(EXPECTED)?;
    if ["\r", "\n", "\r\n"].contains(&end) {
        return Some(end);
    }
    found.fault(format!("{end:?}"), EXPECTED, "choose one");
    None
}

/// Notes a fault where a text cannot be sent as one line.
fn sendable(found: &Found<'_, &str>) {
    let text = found.value;
    if text.len() > TEXT_BYTES_MAX || !text.bytes().all(|byte| (b' '..=b'~').contains(&byte)) {
        let expected = format!("printable ASCII, {TEXT_BYTES_MAX} characters at most");
        let advice = "write one command without its line end";
        found.fault(format!("{text:?}"), &expected, advice);
    }
}

fn command_list(section: &Section<'_>, key: &'static str, required: bool) -> Option<Vec<String>> {
    let texts = section.text_list(key, required, LIST_MAX)?;
    for text in &texts.value {
        sendable(&texts.with(text));
    }
    Some(texts.value.iter().map(|text| (*text).to_owned()).collect())
}

fn questions(root: &Section<'_>, name: &'static str) -> Option<Vec<Question>> {
    let mut questions = Vec::new();
    for section in root.sections(name, LIST_MAX)? {
        section.check_layout(&LAYOUT, &[]);
        let ask = section.required_text("ask", "a harmless question");
        let contains = section.text("contains", "a part of the right answer");
        let one_of = if section.has("one_of") { section.text_list("one_of", false, LIST_MAX) } else { None };
        let digits = section.flag("digits", false);
        let given = usize::from(section.has("contains")) + usize::from(section.has("one_of")) + usize::from(digits);
        if given != 1 {
            let advice = "say with one of them which answers are right";
            let expected = "one of contains, one_of and digits = true";
            section.fault_at(
                "ask",
                ask.as_ref().and_then(|ask| ask.line),
                &format!("{given} of them"),
                expected,
                advice,
            );
        }
        if let Some(ask) = &ask {
            sendable(ask);
        }
        let otherwise = match name {
            "healthy" => section.text("otherwise", "the command that brings the laser to where it answers like that"),
            _ => None,
        };
        if let Some(otherwise) = &otherwise {
            sendable(otherwise);
        }
        let expect = match (contains, one_of) {
            (Some(text), _) => Expected::Contains(text.value.into()),
            (None, Some(texts)) => Expected::OneOf(texts.value.iter().map(|text| (*text).to_owned()).collect()),
            (None, None) => Expected::Digits,
        };
        questions.extend(ask.map(|ask| Question {
            ask: ask.value.into(),
            expect,
            otherwise: otherwise.map(|otherwise| otherwise.value.into()),
        }));
    }
    Some(questions)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_profile_in_the_folder_is_embedded_and_readable() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/profiles/lasers");
        let mut files: Vec<String> = std::fs::read_dir(folder)
            .unwrap()
            .map(|entry| entry.unwrap().path().file_stem().unwrap().to_str().unwrap().to_owned())
            .collect();
        files.sort();
        for (name, text) in FILES {
            TextLaserProfile::parse(text, Path::new(name)).unwrap_or_else(|error| panic!("{error}"));
        }
        assert_eq!(files, TextLaserProfile::names().collect::<Vec<_>>());
    }

    #[test]
    fn a_profile_says_what_is_sent_and_which_answers_are_right() {
        let cobolt = TextLaserProfile::named("cobolt").unwrap();
        assert_eq!(
            (cobolt.baud, cobolt.end_of_command.as_str(), cobolt.power.as_str()),
            (115_200, "\r", "p {power_w}")
        );
        let [number, interlock] = cobolt.identify.as_slice() else { panic!("{:?}", cobolt.identify) };
        assert!(number.expect.accepts("10234") && !number.expect.accepts("") && !number.expect.accepts("P1,3"));
        assert!(interlock.expect.accepts("1") && !interlock.expect.accepts("10"));
        let obis = TextLaserProfile::named("coherent-obis").unwrap();
        assert!(obis.identify[0].expect.accepts("Coherent, Inc-OBIS 638nm 40mW C-V2.3"));
        assert!(!obis.identify[0].expect.accepts("Coherent, Inc-Sapphire"));
    }

    #[test]
    fn all_faults_of_a_profile_are_named_with_their_lines() {
        let text = FILES[0].1;
        for (from, to, key, advice) in [
            ("baud = 115200", "baud = 3", "line.baud", "correct"),
            ("baud = 115200", "bauds = 115200", "line.bauds", "did you mean `baud`?"),
            ("end_of_command = \"\\r\"", "end_of_command = \";\"", "line.end_of_command", "choose one"),
            ("answer_timeout_ms = 500", "answer_timeout_ms = 0.5", "line.answer_timeout_ms", "looks like seconds"),
            ("digits = true", "digits = false", "identify.ask", "which answers"),
            (
                "digits = true",
                "digits = true\notherwise = \"cp\"",
                "identify.otherwise",
                "move `otherwise` to [healthy]",
            ),
            ("otherwise = \"cp\"", "otherwise = \"cp\\r\"", "healthy.otherwise", "without its line end"),
            ("power = \"p {power_w}\"", "power = \"p\"", "commands.power", "{power_mw}"),
            ("on = [\"l1\"]", "on = []", "commands.on", "at least one"),
            ("on = [\"l1\"]", "on = [\"l1\\r\"]", "commands.on", "without its line end"),
            ("on = [\"l1\"]", "on = \"l1\"", "commands.on", "square brackets"),
            ("acknowledge = \"OK\"", "", "commands.acknowledge", "add acknowledge to [commands]"),
        ] {
            let wrong = text.replacen(from, to, 1);
            assert_ne!(wrong, text, "{from}");
            let error = TextLaserProfile::parse(&wrong, Path::new("my.toml")).unwrap_err();
            let fault = error.faults.iter().find(|fault| fault.key == key);
            let fault = fault.unwrap_or_else(|| panic!("{to}: {error}"));
            assert!(fault.line.is_some() && fault.advice.contains(advice), "{to}: {fault}");
        }
        let two = text.replacen("baud = 115200", "baud = 3", 1).replacen("off = [\"l0\"]", "", 1);
        let error = TextLaserProfile::parse(&two, Path::new("my.toml")).unwrap_err();
        assert_eq!(
            error.faults.iter().map(|fault| fault.key.as_str()).collect::<Vec<_>>(),
            ["line.baud", "commands.off"]
        );
        let nameless = text.replacen("description = ", "# ", 1);
        let error = TextLaserProfile::parse(&nameless, Path::new("my.toml")).unwrap_err();
        assert!(
            error
                .to_string()
                .contains("description: found nothing; expected maker and model; add description to the top")
        );
        let no_identity =
            text.split("# It has no word").next().unwrap().to_owned() + &text[text.find("[commands]").unwrap()..];
        let error = TextLaserProfile::parse(&no_identity, Path::new("my.toml")).unwrap_err();
        assert_eq!(error.faults[0].key, "identify", "{error}");
    }
}

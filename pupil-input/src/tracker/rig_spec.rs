//! The tracker that a rig file names, judged while the rig is read, so that its faults are told with the rig's others.

use std::path::Path;

use holod_calibration::toml_reader::Fault;

use super::TrackerError;
use super::job::Job;
use crate::profile::ProfileError;
use crate::spec::{self, TrackerSpec};

impl TrackerSpec {
    /// Reads the spec of a rig file in `folder`, where its relative paths start, and the profile that it names. No port,
    /// device, connection or log is opened.
    ///
    /// # Errors
    /// What is wrong with the spec or with its profile, as faults of the rig file whose key and line are not filled in.
    pub fn of_rig(text: &str, folder: &Path) -> Result<Self, Vec<Fault>> {
        let expected = "a tracker spec, as on the command line";
        let spec = spec::parse(text, folder)
            .map_err(|problem| vec![fault(format!("{text:?}"), expected, format!("correct it: {problem}"))])?
            .in_folder(folder);
        match Job::profile_unopened(&spec) {
            Ok(_) => Ok(spec),
            Err(error) => Err(faults_of(text, error)),
        }
    }
}

fn faults_of(text: &str, error: TrackerError) -> Vec<Fault> {
    let spec_fault = match error {
        TrackerError::Profile(ProfileError::Wrong { origin, faults }) => {
            let of_profile = |of: Fault| {
                let line = of.line.map_or(String::new(), |line| format!(" line {line}"));
                let key = if of.key.is_empty() { String::new() } else { format!(", {}", of.key) };
                Fault { found: format!("{origin}{line}{key}: {}", of.found), key: String::new(), line: None, ..of }
            };
            return faults.into_iter().map(of_profile).collect();
        }
        TrackerError::Profile(ProfileError::Unknown { name, known, advice }) => {
            fault(format!("{text:?} with a profile `{name}`"), &format!("one of {known}"), advice)
        }
        TrackerError::Profile(ProfileError::Unreadable { path, reason }) => fault(
            format!("{}: {reason}", path.display()),
            "a tracker profile that can be read",
            "correct the path (a relative one starts at the rig file's folder) or the file's permissions".into(),
        ),
        TrackerError::WrongLink { profile, link, instead } => fault(
            format!("{text:?} with the profile `{profile}`, which is for {link}"),
            "a profile for a serial port",
            format!("write `{instead}`, or name another profile"),
        ),
        other => fault(format!("{text:?}"), "a tracker that a profile describes", other.to_string()),
    };
    vec![spec_fault]
}

fn fault(found: String, expected: &str, advice: String) -> Fault {
    Fault { key: String::new(), line: None, found, expected: expected.into(), advice }
}

#[cfg(test)]
mod tests {
    use holod_calibration::rig::Rig;

    use super::*;

    /// The faults of a rig file that has this spec in its second line, and another fault in its third.
    fn faults(folder: &Path, spec: &str) -> Vec<String> {
        let path = folder.join("rig.toml");
        std::fs::write(&path, format!("[tracker]\nspec = \"{spec}\"\nhold_ms = 1.0\n")).expect("writes");
        let read = |text: &str, folder: &Path| TrackerSpec::of_rig(text, folder).map(|spec| spec.to_string());
        let error = Rig::load_with(&path, &read).expect_err("the hold time is too short");
        error.faults.iter().map(ToString::to_string).collect()
    }

    #[test]
    fn what_is_wrong_with_a_rigs_tracker_is_told_with_its_line_and_with_the_other_faults() {
        let folder = tempfile::TempDir::new().expect("a folder");
        let profile = folder.path().join("mine.toml");
        std::fs::write(&profile, "name = \"mine\"\nunit = \"parsec\"\nformat = 1\n").expect("writes");
        let mine = format!("found {} line ", profile.display());
        let cases = [
            ("hid:1234", "`1234` is no USB VID:PID"),
            ("usb:host", "unknown kind `usb:`"),
            ("serial:/dev/x,profile=nosuch", "expected one of asl-eye-trac, "),
            ("tcp:host,profile=open-gase", "did you mean `open-gaze`?"),
            ("tcp:host:1,profile=open-gase", "did you mean `open-gaze`?"),
            ("serial:/dev/x,profile=./absent.toml", "absent.toml: No such file"),
            ("serial:/dev/x,profile=mine.toml", &mine),
            ("udp:host,profile=mine.toml", "mine.toml: "),
            ("serial:/dev/x,profile=holod-hid", "write `hid:VID:PID`"),
            ("hid:046d:c31c", "no shipped profile"),
            ("hid:,profile=open-gaze", "names no HID device"),
        ];
        for (spec, told) in cases {
            let faults = faults(folder.path(), spec);
            let (last, of_spec) = faults.split_last().expect("faults");
            assert!(last.starts_with("line 3, tracker.hold_ms: "), "{spec}: {faults:#?}");
            assert!(!of_spec.is_empty(), "{spec}");
            for fault in of_spec {
                assert!(fault.starts_with("line 2, tracker.spec: found "), "{spec}: {fault}");
            }
            assert!(of_spec.iter().any(|fault| fault.contains(told)), "{spec}: {faults:#?}");
        }
        for sound in
            ["mock", "log.csv", "/dev/ttyUSB0", "serial:/dev/x,profile=iscan-etl", "tcp:host,profile=open-gaze"]
        {
            assert_eq!(faults(folder.path(), sound).len(), 1, "{sound}");
        }
    }

    #[test]
    fn relative_paths_of_a_rigs_tracker_start_at_its_folder() {
        let folder = tempfile::TempDir::new().expect("a folder");
        let text = include_str!("../../profiles/open-gaze.toml");
        std::fs::write(folder.path().join("mine.toml"), text).expect("writes");
        let expected = format!("tcp:host:4242,profile={}", folder.path().join("mine.toml").display());
        assert_eq!(
            TrackerSpec::of_rig("tcp:host,profile=mine.toml", folder.path()),
            Ok(expected.parse().expect("a spec"))
        );
    }
}

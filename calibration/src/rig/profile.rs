//! Known panels: the figures that follow from a panel's model alone.
//!
//! What depends on the bench (field order, phase sign, stroke, settle time) is never in a profile.

use std::sync::LazyLock;

use toml_edit::{Document, Table};

const FILES: [(&str, &str); 8] = [
    ("hamamatsu-x15213", include_str!("../../profiles/panels/hamamatsu-x15213.toml")),
    ("holoeye-eris", include_str!("../../profiles/panels/holoeye-eris.toml")),
    ("holoeye-gaea-2.1", include_str!("../../profiles/panels/holoeye-gaea-2.1.toml")),
    ("holoeye-leto", include_str!("../../profiles/panels/holoeye-leto.toml")),
    ("holoeye-pluto", include_str!("../../profiles/panels/holoeye-pluto.toml")),
    ("jasper-4k", include_str!("../../profiles/panels/jasper-4k.toml")),
    ("meadowlark-hdmi-1920x1152", include_str!("../../profiles/panels/meadowlark-hdmi-1920x1152.toml")),
    ("santec-slm-200", include_str!("../../profiles/panels/santec-slm-200.toml")),
];

static PROFILES: LazyLock<Vec<PanelProfile>> =
    LazyLock::new(|| FILES.into_iter().filter_map(PanelProfile::of).collect());

/// What is known of a panel from its model alone.
#[derive(Debug)]
pub struct PanelProfile {
    /// The name that a rig file gives in `panel.profile`.
    pub name: &'static str,
    /// Maker and model, as messages name them.
    pub description: String,
    /// Where the figures come from.
    pub source: String,
    /// The keys whose figures no source confirms.
    pub unverified: Vec<String>,
    values: Table,
}

impl PanelProfile {
    /// Every profile there is, by name.
    pub fn all() -> &'static [Self] {
        &PROFILES
    }

    /// The profile called `name`.
    pub fn named(name: &str) -> Option<&'static Self> {
        PROFILES.iter().find(|profile| profile.name == name)
    }

    /// The profile's keys, named as in a rig file's `[panel]`.
    pub(super) fn values(&self) -> &Table {
        &self.values
    }

    fn of((name, text): (&'static str, &str)) -> Option<Self> {
        let document = Document::parse(text.to_owned()).ok()?;
        let unverified = document.get("unverified")?.as_array()?;
        Some(Self {
            name,
            description: document.get("description")?.as_str()?.into(),
            source: document.get("source")?.as_str()?.into(),
            unverified: unverified.iter().filter_map(|key| Some(key.as_str()?.to_owned())).collect(),
            values: document.get("panel")?.as_table()?.clone(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_profile_in_the_folder_is_embedded_and_readable() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/profiles/panels");
        let mut files: Vec<String> = std::fs::read_dir(folder)
            .unwrap()
            .map(|entry| entry.unwrap().path().file_stem().unwrap().to_str().unwrap().to_owned())
            .collect();
        files.sort();
        let names: Vec<&str> = PanelProfile::all().iter().map(|profile| profile.name).collect();
        assert_eq!(files, names);
    }

    #[test]
    fn what_a_profile_calls_unverified_is_among_its_keys() {
        for profile in PanelProfile::all() {
            for key in &profile.unverified {
                assert!(profile.values.contains_key(key), "{}: {key}", profile.name);
            }
        }
    }
}

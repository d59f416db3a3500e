//! What `holod --version` says: version, commit, features.

use std::env;
use std::fs;
use std::path::Path;
use std::process::Command;

/// The commit, written into archives that git makes; git replaces the text between the dollar signs.
const ARCHIVED: &str = "archived-commit";

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed={ARCHIVED}");
    println!("cargo::rerun-if-env-changed=HOLOD_COMMIT");
    let version = env::var("CARGO_PKG_VERSION").expect("cargo sets it");
    println!("cargo::rustc-env=HOLOD_VERSION={version} ({}, {})", origin(), features());
}

fn origin() -> String {
    let given = env::var("HOLOD_COMMIT").ok().filter(|commit| !commit.is_empty());
    let release = env::var("PROFILE").is_ok_and(|profile| profile == "release");
    match given.or_else(archived) {
        Some(commit) => format!("commit {commit}"),
        // Asked at each commit, this would build the daemon anew at each commit.
        None if !release => "debug build".to_owned(),
        None => checked_out().map_or_else(|| "commit unknown".to_owned(), |commit| format!("commit {commit}")),
    }
}

fn archived() -> Option<String> {
    let text = fs::read_to_string(ARCHIVED).ok()?;
    let text = text.trim();
    let is_commit = !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_hexdigit());
    is_commit.then(|| text.to_owned())
}

/// The commit of the checkout, and whether it is what is built.
fn checked_out() -> Option<String> {
    // Another repository may lie around an unpacked archive.
    let root = git(&["rev-parse", "--show-toplevel"])?;
    if fs::canonicalize(root).ok()? != fs::canonicalize("..").ok()? {
        return None;
    }
    let commit = git(&["rev-parse", "--short=12", "HEAD"])?;
    watch()?;
    let changed = git(&["status", "--porcelain", "--untracked-files=no"])?;
    Some(if changed.is_empty() { commit } else { format!("{commit}, modified") })
}

/// Builds anew when another commit is checked out, or what is built of it changes.
fn watch() -> Option<()> {
    println!("cargo::rerun-if-changed={}", git(&["rev-parse", "--git-path", "HEAD"])?);
    if let Some(branch) = git(&["symbolic-ref", "HEAD"]) {
        for file in [branch.as_str(), "packed-refs"] {
            let path = git(&["rev-parse", "--git-path", file])?;
            if Path::new(&path).exists() {
                println!("cargo::rerun-if-changed={path}");
            }
        }
    }
    for folder in ["../calibration", "../pupil-input", "../model/src", "../slm-output", "src", "../Cargo.lock"] {
        println!("cargo::rerun-if-changed={folder}");
    }
    Some(())
}

fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

fn features() -> String {
    let mut features: Vec<String> = env::vars()
        .filter_map(|(name, _)| name.strip_prefix("CARGO_FEATURE_").map(str::to_lowercase))
        .map(|name| name.replace('_', "-"))
        .filter(|name| name != "default")
        .collect();
    features.sort();
    match &features[..] {
        [] => "no features".to_owned(),
        features => format!("features {}", features.join(" ")),
    }
}

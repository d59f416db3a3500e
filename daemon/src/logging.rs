//! What the log on standard error says, by `HOLOD_LOG`.

use tracing_subscriber::EnvFilter;

const LEVELS: [&str; 6] = ["off", "error", "warn", "info", "debug", "trace"];
const DEFAULT: &str = "info";

/// The filter that `HOLOD_LOG` asks for: a level, or directives such as `holod_daemon=debug`, separated by commas, over the
/// usual `info`. With what is wrong with it, which is then left out.
pub fn filter(asked: Option<&str>) -> (EnvFilter, Option<String>) {
    let (mut directives, mut wrong) = (Vec::new(), Vec::new());
    for directive in asked.unwrap_or_default().split(',').map(str::trim).filter(|directive| !directive.is_empty()) {
        let level = directive.rsplit_once('=').map_or(directive, |(_, level)| level).to_lowercase();
        let is_right =
            LEVELS.contains(&level.as_str()) && directive.parse::<tracing_subscriber::filter::Directive>().is_ok();
        if is_right { directives.push(directive) } else { wrong.push(directive) }
    }
    // A directive for a part of the program leaves the rest as it is.
    if directives.iter().all(|directive| directive.contains('=')) {
        directives.push(DEFAULT);
    }
    let complaint = (!wrong.is_empty()).then(|| {
        format!(
            "HOLOD_LOG: found `{}`, expected one of {}, or directives such as holod_daemon=debug; it is left out",
            wrong.join(","),
            LEVELS.join(", ")
        )
    });
    (EnvFilter::new(directives.join(",")), complaint)
}

#[cfg(test)]
mod tests {
    use super::*;
    use tracing_subscriber::filter::LevelFilter;

    fn most(asked: &str) -> (Option<LevelFilter>, bool) {
        let (filter, complaint) = filter(Some(asked));
        (filter.max_level_hint(), complaint.is_some())
    }

    #[test]
    fn levels_and_directives_are_taken_and_a_typo_silences_nothing() {
        assert_eq!(filter(None).0.max_level_hint(), Some(LevelFilter::INFO));
        assert_eq!(most("debug"), (Some(LevelFilter::DEBUG), false));
        assert_eq!(most("WARN"), (Some(LevelFilter::WARN), false));
        assert_eq!(most("holod_daemon=trace"), (Some(LevelFilter::TRACE), false));
        assert_eq!(most("debgu"), (Some(LevelFilter::INFO), true));
        assert_eq!(most("holod_daemon=loud"), (Some(LevelFilter::INFO), true));
        assert_eq!(most("debgu,debug"), (Some(LevelFilter::DEBUG), true));
        assert!(filter(Some("debgu")).1.unwrap().contains("`debgu`"));
    }
}

//! One file for each subcommand.

mod bench;
mod check;
mod ctl;
mod demo;
mod evaluate;
mod focal_stack;
mod hologram_files;
mod laser;
mod log;
mod lut;
mod pattern;
mod render;
mod report;
mod run;
mod service_facts;
mod status;
mod tracker;
mod unit;
mod view;

use crate::cli::{Cli, Command};
use crate::failure::Failure;

/// Does what the command line asks for.
///
/// # Errors
/// Whatever ended it early, with its exit code.
pub fn dispatch(cli: Cli) -> Result<(), Failure> {
    match cli.command {
        None => run::run(&cli.run),
        Some(Command::Run(args)) => run::run(&args),
        Some(Command::Demo(args)) => demo::demo(&args),
        Some(Command::Render(args)) => render::render(&args),
        Some(Command::View(args)) => view::view(&args),
        Some(Command::Check(args)) => check::check(&args),
        Some(Command::Unit(args)) => unit::unit(&args),
        Some(Command::Bench(args)) => bench::bench(&args),
        Some(Command::Evaluate(args)) => evaluate::evaluate(&args),
        Some(Command::Pattern(kind)) => pattern::pattern(&kind),
        Some(Command::Lut(args)) => lut::lut(&args),
        Some(Command::Status(args)) => status::status(&args),
        Some(Command::Ctl(args)) => ctl::ctl(&args),
        Some(Command::Report(args)) => report::report(&args),
        Some(Command::Tracker(command)) => tracker::tracker(&command),
        Some(Command::Log(command)) => log::log(&command),
        Some(Command::Laser(command)) => laser::laser(&command),
        Some(Command::Dark(args)) => laser::dark(&args),
    }
}

//! The log of what a box's lasers did: lines of CSV.

use std::io::{self, Write};

use holod_calibration::{Colour, TimeNs};

use super::{BoxEvent, DarkReason, LaserEdge};

/// First line of a log.
pub const LOG_HEADER: &str = "t_ns,event,colour,reason";

/// Writes one line.
///
/// # Errors
/// [`io::Error`] where it cannot be written.
pub fn write_event(log: &mut impl Write, event: BoxEvent) -> io::Result<()> {
    match event {
        BoxEvent::Armed { t } => writeln!(log, "{},armed,,", t.0),
        BoxEvent::Edge(LaserEdge { t, colour, on }) => {
            writeln!(log, "{},{},{colour},", t.0, if on { "on" } else { "off" })
        }
        BoxEvent::Dark { t, reason } => writeln!(log, "{},dark,,{reason}", t.0),
    }
}

/// Reads a log; a last line that was cut off is left out.
///
/// # Errors
/// The number (from 1) of the first line that is no line of a log.
pub fn read_log(text: &str) -> Result<Vec<BoxEvent>, usize> {
    let whole = text.rfind('\n').map_or("", |end| &text[..end]);
    let lines = whole.lines().enumerate().filter(|(_, line)| *line != LOG_HEADER);
    lines.map(|(index, line)| read_event(line).ok_or(index + 1)).collect()
}

fn read_event(line: &str) -> Option<BoxEvent> {
    let mut cells = line.split(',');
    let t = TimeNs(cells.next()?.parse().ok()?);
    let (event, colour, reason) = (cells.next()?, cells.next()?, cells.next()?);
    let colour = || Colour::ALL.into_iter().find(|known| known.name() == colour);
    match event {
        "armed" => Some(BoxEvent::Armed { t }),
        "on" | "off" => Some(BoxEvent::Edge(LaserEdge { t, colour: colour()?, on: event == "on" })),
        "dark" => Some(BoxEvent::Dark { t, reason: DarkReason::from_name(reason)? }),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_is_read_as_it_was_written() {
        let mut events = vec![
            BoxEvent::Armed { t: TimeNs(5) },
            BoxEvent::Edge(LaserEdge { t: TimeNs(7), colour: Colour::Blue, on: true }),
            BoxEvent::Edge(LaserEdge { t: TimeNs(9), colour: Colour::Blue, on: false }),
        ];
        events.extend(DarkReason::ALL.map(|reason| BoxEvent::Dark { t: TimeNs(10), reason }));
        let mut log = format!("{LOG_HEADER}\n").into_bytes();
        for event in &events {
            write_event(&mut log, *event).unwrap();
        }
        let text = String::from_utf8(log).unwrap();
        assert_eq!(read_log(&text), Ok(events.clone()));
        assert_eq!(read_log(&format!("{text}12,on,re")), Ok(events.clone()));
        assert_eq!(read_log(&format!("{text}12,on,ultraviolet,\n")), Err(events.len() + 2));
    }
}

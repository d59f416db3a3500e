//! The laser box's firmware, fed a bench's history: lines, noise, edges, an interlock, a host that comes and goes,
//! time.
//!
//! Each line of the input is one deed: `+N` lets N microseconds go by, `e` is an edge on the sync wire, `o` and `c`
//! open and close the interlock, `g` and `h` take the host away and bring it back, `=BYTES` sends them as they are, and
//! anything else is sent as a line with its checksum.
#![no_main]

use holod_fuzz::counting;
use holod_laser_firmware::{Controller, Event, Hardware, Laser, Limits, Line, TimeUs};
use libfuzzer_sys::fuzz_target;

const LIMITS: Limits =
    Limits { power_uw: [2000, 1000, 3000], timeout_us: 200_000, lit_us: 8000, jitter_us: 20, sync_input: true };

#[derive(Default)]
struct Board {
    now_us: u64,
    edge: Option<TimeUs>,
    interlock_open: bool,
    host_absent: bool,
    to_box: Vec<u8>,
    taken: usize,
    gate: Option<Laser>,
    power_uw: [u32; 3],
}

impl Hardware for Board {
    fn now(&mut self) -> TimeUs {
        TimeUs(self.now_us)
    }
    fn sync_edge(&mut self) -> Option<TimeUs> {
        self.edge.take()
    }
    fn interlock_closed(&mut self) -> bool {
        !self.interlock_open
    }
    fn host_present(&mut self) -> bool {
        !self.host_absent
    }
    fn receive(&mut self, bytes: &mut [u8]) -> usize {
        let waiting = &self.to_box[self.taken..];
        let count = waiting.len().min(bytes.len());
        bytes[..count].copy_from_slice(&waiting[..count]);
        self.taken += count;
        count
    }
    fn send(&mut self, line: &[u8]) {
        assert_eq!(line.iter().position(|&byte| byte == b'\n'), Some(line.len() - 1), "one whole line at a time");
    }
    fn set_gate(&mut self, lit: Option<Laser>) {
        if let Some(laser) = lit {
            assert!(!self.interlock_open && !self.host_absent, "lit with an open interlock or without a host");
            assert!(self.power_uw[laser.index()] <= LIMITS.power_uw[laser.index()]);
        }
        self.gate = lit;
    }
    fn set_power(&mut self, power_uw: [u32; 3]) {
        assert!(self.gate.is_none(), "the power changes while a gate is open");
        self.power_uw = power_uw;
    }
    fn feed_watchdog(&mut self) {}
}

/// What the events must keep to.
#[derive(Default)]
struct Judge {
    armed: bool,
    lit: Option<(Laser, u64)>,
    t_last: u64,
    /// The last time at which the box heard anything: whatever it was may have been a heartbeat.
    t_heard: u64,
}

impl Judge {
    fn see(&mut self, event: Event) {
        let (Event::Armed { t } | Event::On { t, .. } | Event::Off { t, .. } | Event::Dark { t, .. }) = event;
        assert!(t.0 >= self.t_last, "{event:?} after {}", self.t_last);
        self.t_last = t.0;
        match event {
            Event::Armed { .. } => assert!(!std::mem::replace(&mut self.armed, true)),
            Event::On { laser, .. } => {
                assert!(self.armed && self.lit.is_none(), "{event:?}, lit {:?}", self.lit);
                self.lit = Some((laser, t.0));
            }
            Event::Off { laser, .. } => {
                let (lit, t_on) = self.lit.take().expect("a laser that goes off was on");
                assert!(lit == laser && t.0 - t_on <= u64::from(LIMITS.lit_us));
                assert!(t.0 <= self.t_heard + u64::from(LIMITS.timeout_us), "lit without a heartbeat");
            }
            Event::Dark { .. } => assert!(std::mem::replace(&mut self.armed, false) && self.lit.is_none()),
        }
    }
}

fuzz_target!(|bytes: &[u8]| {
    let mut judge = Judge::default();
    let mut controller = Controller::new(Board::default(), "fuzzed", LIMITS);
    for deed in bytes.split(|&byte| byte == b'\n') {
        let board = controller.hardware_mut();
        board.to_box.clear();
        board.taken = 0;
        match deed {
            b"e" => board.edge = Some(TimeUs(board.now_us)),
            b"o" => board.interlock_open = true,
            b"c" => board.interlock_open = false,
            b"g" => board.host_absent = true,
            b"h" => board.host_absent = false,
            [b'+', digits @ ..] => {
                let us = std::str::from_utf8(digits).ok().and_then(|digits| digits.parse::<u64>().ok()).unwrap_or(10);
                board.now_us += us.min(2_000_000);
            }
            [b'=', raw @ ..] => board.to_box.extend_from_slice(raw),
            text => {
                if let Some(line) = std::str::from_utf8(text).ok().and_then(Line::new) {
                    board.to_box.extend_from_slice(line.as_bytes());
                }
            }
        }
        let steps = 1 + board.to_box.len() / 64;
        let (now_us, heard) = (board.now_us, !board.to_box.is_empty());
        let mut events = [None; 64];
        let mut count = 0;
        let before = counting::here();
        for _ in 0..steps {
            controller.step(&mut |event| {
                events[count] = Some(event);
                count += 1;
            });
        }
        assert_eq!(counting::here(), before, "the firmware takes memory");
        for event in events.iter().flatten() {
            judge.see(*event);
        }
        if heard {
            judge.t_heard = now_us;
        }
    }
    controller.hardware_mut().now_us += 10_000_000;
    controller.step(&mut |event| judge.see(event));
    assert!(!judge.armed && judge.lit.is_none() && !controller.machine().is_armed(), "it goes dark by itself");
    assert_eq!(controller.hardware_mut().gate, None);
});

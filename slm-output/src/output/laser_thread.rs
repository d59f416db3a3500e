//! The thread of the lasers.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use holod_calibration::TimeNs;
use rtrb::{Consumer, Producer};

use super::ledger::Ledger;
use super::panel_thread::PanelNews;
use super::shared::{DARK, FAILED, NOT_YET, Shared, count, dark_request_parts};
use super::{Clock, SLEEP_MAX};
use crate::laser::{BoxEvent, DarkReason, LaserBox, LaserError, LaserProgram};
use crate::present::PresentedRefresh;
use crate::schedule::{FieldDecision, FieldScheduler, Orders};

/// How long a laser box that failed is left alone.
const RETRY_AFTER: TimeNs = TimeNs(1_000_000_000);

pub(super) struct LaserThread {
    pub(super) laser: Box<dyn LaserBox>,
    pub(super) program: LaserProgram,
    pub(super) scheduler: FieldScheduler,
    pub(super) news: Consumer<PanelNews>,
    pub(super) ledger: Ledger,
    /// What went wrong with the box, for whoever tells people.
    pub(super) faults: Producer<LaserError>,
    /// The number of the last of the requests for darkness, or to take it back.
    pub(super) dark_request: u64,
    /// Why it asks for darkness, where it does.
    pub(super) asked: Option<DarkReason>,
    /// Nobody has been at the control for too long.
    pub(super) is_unattended: bool,
    /// A box that failed is left alone until then.
    pub(super) t_retry: TimeNs,
    /// The box failed and may have lost its program.
    pub(super) program_lost: bool,
    pub(super) shared: Arc<Shared>,
    /// From the display's report of a refresh to the panel's update with it.
    pub(super) latency: TimeNs,
    pub(super) clock: Clock,
}

impl LaserThread {
    pub(super) fn run(mut self) {
        loop {
            let stop = self.shared.stop.load(Ordering::Acquire);
            let clock = self.clock;
            let now = self.step(clock);
            if stop {
                self.ledger.flush(TimeNs(i64::MAX), &self.shared);
                return;
            }
            let t_next = self.scheduler.t_next().into_iter().chain(self.t_news(now)).min();
            let t_next = t_next.map_or(SLEEP_MAX, |t| (t - now).max(TimeNs(0)));
            let rest = t_next.min(self.scheduler.gate().timing().field_period).min(SLEEP_MAX);
            std::thread::park_timeout(Duration::from_nanos(rest.0 as u64));
        }
    }

    /// Does all that is to be done at the time that `clock` says, which is handed back. The clock is read again for
    /// each field: a field that came since the last reading is not one that was reported before it was shown.
    pub(super) fn step(&mut self, clock: impl Fn() -> TimeNs) -> TimeNs {
        self.poll(clock());
        self.decide_fields(clock(), &clock);
        // What comes meanwhile waits for the next turn: where a box answers more slowly than refreshes come, this one
        // would never end.
        for _ in 0..self.news.slots() {
            let now = clock();
            if self.t_news(now).is_none_or(|t| t > now) {
                break;
            }
            let Ok(news) = self.news.pop() else { break };
            match news {
                // The panel was lost before it could show it.
                PanelNews::Refresh(refresh) if self.is_to_come(&refresh, now) => {}
                PanelNews::Refresh(refresh) => {
                    // What the panel showed before is over by then, however late this thread is.
                    self.decide_fields(refresh.t_present.min(clock()), &clock);
                    self.scheduler.on_refresh(&refresh);
                    self.decide_fields(clock(), &clock);
                }
                PanelNews::Lost => {
                    let orders = self.scheduler.panel_lost();
                    self.obey(orders, clock());
                }
            }
        }
        let now = clock();
        // Reports that wait are not missing.
        if self.t_news(now).is_none_or(|t| t > now) {
            let orders = self.scheduler.watch(now);
            self.obey(orders, now);
        }
        self.poll(now);
        self.shared.armed.store(self.scheduler.is_armed(), Ordering::Relaxed);
        self.shared.refresh_millihz.store((self.scheduler.refresh_hz() * 1e3).round() as u64, Ordering::Relaxed);
        self.ledger.flush(self.laser.known_until(now), &self.shared);
        now
    }

    /// When the oldest of the panel's news is to be dealt with: at once, but for a refresh that is not on the panel yet.
    pub(super) fn t_news(&self, now: TimeNs) -> Option<TimeNs> {
        let is_lost = self.shared.panel_lost.load(Ordering::Acquire);
        match self.news.peek().ok()? {
            PanelNews::Refresh(refresh) if !is_lost && self.is_to_come(refresh, now) => Some(refresh.t_present),
            PanelNews::Refresh(_) | PanelNews::Lost => Some(now),
        }
    }

    /// Whether a refresh that the display took is still on its way to the panel. One that is farther off than the
    /// latency was reported before its time, and is judged at once, as it would be without one.
    fn is_to_come(&self, refresh: &PresentedRefresh, now: TimeNs) -> bool {
        now < refresh.t_present && refresh.t_present.0 <= now.0.saturating_add(self.latency.0)
    }

    /// Obeys those who want darkness, for good or until they take it back, and keeps dark while nobody could want it.
    fn heed(&mut self, now: TimeNs) {
        if let Some(reason) = self.shared.latched() {
            self.latch(reason, now);
        }
        let (request, why) = dark_request_parts(self.shared.dark_request.load(Ordering::Acquire));
        let is_new = request != self.dark_request;
        let is_unattended = !self.shared.is_attended(now);
        if !is_new && is_unattended == self.is_unattended {
            return;
        }
        if is_new {
            (self.dark_request, self.asked) = (request, why);
        }
        self.is_unattended = is_unattended;
        let orders = self.scheduler.hold(self.asked.or(is_unattended.then_some(DarkReason::Unattended)));
        let answer = self.darkness(orders, now);
        if is_new {
            self.shared.dark_answer.store(request << 2 | u64::from(answer), Ordering::Release);
        }
    }

    /// Does what is to be done about the fields that have begun by `now`.
    fn decide_fields(&mut self, now: TimeNs, clock: &impl Fn() -> TimeNs) {
        loop {
            // Before each of them: the box may have been waited for since the last one, and it must not be armed
            // against an order.
            self.heed(clock());
            let Some(FieldDecision { shown, orders, mut dark }) = self.scheduler.next_field(now) else { return };
            if orders.arm && now < self.t_retry {
                dark = Some(self.scheduler.not_armed());
            } else {
                let unlit = self.obey(orders, now);
                if unlit.is_some() && orders.light.is_some() {
                    self.scheduler.stayed_dark();
                }
                dark = unlit.or(dark);
            }
            self.ledger.field(&shown, dark, &self.shared);
        }
    }

    /// Does what the scheduler says. Why the box does not light the field all the same, if so.
    fn obey(&mut self, orders: Orders, now: TimeNs) -> Option<DarkReason> {
        self.try_obey(orders, now).unwrap_or_else(|error| {
            let reason = error.dark_reason();
            self.fault(error, now);
            Some(reason)
        })
    }

    fn try_obey(&mut self, orders: Orders, now: TimeNs) -> Result<Option<DarkReason>, LaserError> {
        if let Some(reason) = orders.dark {
            return self.laser.dark(reason, now).map(|()| None);
        }
        if orders.arm {
            if std::mem::take(&mut self.program_lost) {
                self.laser.program(&self.program, now)?;
            }
            self.laser.arm(now)?;
            // Of windows of before, which the colours' light is no longer counted from.
            self.take_missed(false);
        }
        if orders.heartbeat {
            self.laser.heartbeat(now)?;
        }
        let unsynced = match orders.sync {
            Some(t_sync) => self.laser.sync(t_sync, now)?,
            None => None,
        };
        let unlit = match orders.light {
            Some(window) => self.laser.light(window, now)?,
            None => None,
        };
        Ok(unsynced.or(unlit))
    }

    fn fault(&mut self, error: LaserError, now: TimeNs) {
        let reason = error.dark_reason();
        self.note(error);
        self.scheduler.box_went_dark(reason);
        self.program_lost = true;
        self.t_retry = now + RETRY_AFTER;
        if let Err(error) = self.laser.dark(reason, now) {
            self.note(error);
        }
    }

    /// Counts a fault of the box and hands it over to whoever tells people; where nobody has listened it is only
    /// counted.
    fn note(&mut self, error: LaserError) {
        count(&self.shared.box_faults);
        let _counted = self.faults.push(error);
    }

    pub(super) fn latch(&mut self, reason: DarkReason, now: TimeNs) {
        if self.shared.acknowledged.load(Ordering::Acquire) != NOT_YET {
            return;
        }
        let orders = self.scheduler.latch(reason);
        let answer = self.darkness(orders, now);
        self.shared.acknowledged.store(answer, Ordering::Release);
    }

    /// Orders darkness; what the box says to it.
    fn darkness(&mut self, orders: Orders, now: TimeNs) -> u8 {
        match self.try_obey(orders, now) {
            Ok(_) => DARK,
            Err(error) => {
                self.note(error);
                FAILED
            }
        }
    }

    fn poll(&mut self, now: TimeNs) {
        let Self { laser, ledger, scheduler, shared, .. } = self;
        let polled = laser.poll(now, &mut |event| {
            if let BoxEvent::Dark { reason, .. } = event {
                scheduler.box_went_dark(reason);
                count(&shared.went_dark);
            }
            ledger.box_event(event, shared);
        });
        if let Err(error) = polled
            && now >= self.t_retry
        {
            self.fault(error, now);
        }
        self.take_missed(true);
    }

    /// Takes note of the light that the box missed; whether it counts for the `balance` of the colours.
    fn take_missed(&mut self, balance: bool) {
        while let Some(missed) = self.laser.next_missed() {
            if balance {
                self.scheduler.missed(missed.window.colour, missed.time);
            }
            if missed.is_whole() {
                self.ledger.came_late(&missed.window);
            } else {
                count(&self.shared.lit_in_part);
            }
        }
    }
}

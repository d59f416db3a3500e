//! The machine's sleep. It freezes holod and leaves lasers without a heartbeat as they are, so lasers are put out
//! before: logind says when, and waits for that.
//!
//! What talks with logind is a thread of its own. The control thread looks at what it has to say, and never waits for
//! the bus.

use std::convert::Infallible;
use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use holod_calibration::rig::LaserDriver;
use holod_slm_output::laser::DarkReason;
use rustix::time::{ClockId, clock_gettime};
use tokio::sync::mpsc::error::SendError;
use tokio::sync::{mpsc, oneshot};
use tokio_stream::StreamExt;
use zbus::proxy::CacheProperties;
use zbus::zvariant::OwnedFd;
use zbus::{Proxy, connection, proxy};

/// How soon the thread sees that the run is over, or that lasers may be lit or may not; where logind does not say that
/// the machine is awake, it is asked as often.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// How long a bus that is not there is left alone.
const RETRY_AFTER: Duration = Duration::from_secs(5);
const ANSWER_WITHIN: Duration = Duration::from_secs(5);
/// A machine that is still awake so long after it was about to sleep will not.
const SLEEPS_WITHIN: Duration = Duration::from_secs(60);
/// The property of logind that is true from before the machine sleeps until it is awake.
const PREPARING: &str = "PreparingForSleep";

/// The control thread's view of the machine's sleep.
pub(crate) struct SleepWatch {
    news: mpsc::Receiver<News>,
    may_be_lit: Arc<AtomicBool>,
    keeps_dark: bool,
    /// Told once the lasers are dark.
    may_sleep: Option<oneshot::Sender<()>>,
    /// What the machine had slept before, since it was started.
    slept_before: Duration,
}

#[derive(Debug)]
enum News {
    /// The machine is about to sleep, and does so once the lasers are dark.
    Sleeps(oneshot::Sender<()>),
    /// It is awake again, or does not sleep after all.
    Awake,
}

impl SleepWatch {
    /// Begins to listen to logind, on a thread that ends soon after this is dropped. A run goes on without it, and one
    /// without lasers needs none.
    pub(crate) fn begin(driver: &LaserDriver) -> Self {
        let (sender, news) = mpsc::channel(1);
        let may_be_lit = Arc::new(AtomicBool::new(true));
        let this = Self {
            news,
            may_be_lit: Arc::clone(&may_be_lit),
            keeps_dark: false,
            may_sleep: None,
            slept_before: Duration::ZERO,
        };
        if matches!(driver, LaserDriver::Simulated) {
            return this;
        }
        let listener =
            Listener { news: sender, may_be_lit, has_heartbeat: driver.has_heartbeat(), dark_since: None, told: None };
        let thread = std::thread::Builder::new().name("holod-sleep".into()).spawn(move || listener.run());
        if let Err(error) = thread {
            tracing::warn!("lasers are not put out before the machine sleeps: cannot start a thread for that: {error}");
        }
        this
    }

    /// Whether there is something that lasers are to be told: [`Self::keeps_dark`], and then [`Self::told`].
    pub(crate) fn look(&mut self) -> bool {
        match self.news.try_recv() {
            Ok(News::Sleeps(may_sleep)) => {
                (self.keeps_dark, self.may_sleep, self.slept_before) = (true, Some(may_sleep), slept());
                true
            }
            Ok(News::Awake) => {
                self.keeps_dark = false;
                true
            }
            Err(_) => false,
        }
    }

    /// Why lasers are to be dark, where they are.
    pub(crate) fn keeps_dark(&self) -> Option<DarkReason> {
        self.keeps_dark.then_some(DarkReason::Sleep)
    }

    /// The lasers were told to be dark for `why`, or to be lit by the rules; `acknowledged`: they are dark where they
    /// are to be. The machine may sleep then.
    pub(crate) fn told(&mut self, why: Option<DarkReason>, acknowledged: bool) {
        if !self.keeps_dark {
            let slept = slept().saturating_sub(self.slept_before).as_secs();
            let slept = humantime::format_duration(Duration::from_secs(slept));
            match why {
                None => tracing::info!("the machine is awake after {slept} of sleep: lasers are lit by the rules"),
                Some(why) => tracing::info!("the machine is awake after {slept} of sleep: lasers stay dark ({why})"),
            }
        } else if acknowledged {
            tracing::info!("lasers dark: the machine is about to sleep");
        } else {
            tracing::error!(
                "the machine is about to sleep, but the laser box did not acknowledge darkness: look at the lasers, and \
                 switch them off by hand"
            );
        }
        if let Some(may_sleep) = self.may_sleep.take() {
            // A machine that did not wait may be awake again.
            let _nobody_waits = may_sleep.send(());
        }
    }

    /// An idle machine sleeps only where no laser may be lit.
    pub(crate) fn may_be_lit(&self, may_be_lit: bool) {
        self.may_be_lit.store(may_be_lit, Ordering::Relaxed);
    }
}

/// How long the machine has slept since it was started.
fn slept() -> Duration {
    let [all, awake] = [ClockId::Boottime, ClockId::Monotonic].map(|clock| {
        let time = clock_gettime(clock);
        Duration::new(time.tv_sec as u64, time.tv_nsec as u32)
    });
    all.saturating_sub(awake)
}

/// The thread that talks with logind.
struct Listener {
    news: mpsc::Sender<News>,
    may_be_lit: Arc<AtomicBool>,
    has_heartbeat: bool,
    /// When the control thread was told that the machine sleeps, and what it had slept before; nothing once it was told
    /// that it is awake. That time stands still while the machine sleeps.
    dark_since: Option<(Instant, Duration)>,
    /// What people were told last: whether logind waits for the lasers.
    told: Option<bool>,
}

/// Why the thread does not listen any more.
#[derive(Debug)]
enum Ended {
    /// The run is over.
    Run,
    /// The bus, or logind.
    Bus(zbus::Error),
}

impl From<zbus::Error> for Ended {
    fn from(error: zbus::Error) -> Self {
        Self::Bus(error)
    }
}

impl From<SendError<News>> for Ended {
    fn from(_: SendError<News>) -> Self {
        Self::Run
    }
}

impl Listener {
    fn run(mut self) {
        let runtime = match tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build() {
            Ok(runtime) => runtime,
            Err(error) => return self.tell_fault(&error),
        };
        runtime.block_on(async {
            while let Err(Ended::Bus(error)) = self.listen().await {
                self.tell_fault(&error);
                // Not longer than the run.
                let _over = tokio::time::timeout(RETRY_AFTER, self.news.closed()).await;
                if self.is_awake_again() && self.light().await.is_err() {
                    return;
                }
            }
        });
    }

    /// Listens until something ends that. Where the machine was about to sleep when the bus was lost, lasers stay dark
    /// until it is known to be awake, or has not slept for a minute.
    async fn listen(&mut self) -> Result<Infallible, Ended> {
        if self.news.is_closed() {
            return Err(Ended::Run);
        }
        let bus = connection::Builder::system()?.method_timeout(ANSWER_WITHIN).build();
        let bus = tokio::time::timeout(ANSWER_WITHIN, bus).await.map_err(|_| failure("the bus does not answer"))??;
        let logind: Proxy<'_> = proxy::Builder::new(&bus)
            .destination("org.freedesktop.login1")?
            .path("/org/freedesktop/login1")?
            .interface("org.freedesktop.login1.Manager")?
            .cache_properties(CacheProperties::No)
            .build()
            .await?;
        let mut signals = logind.receive_signal("PrepareForSleep").await?;
        let mut sleeps: bool = logind.get_property(PREPARING).await?;
        // In force until they are dropped.
        let (mut delay, mut idle) = (None, None);
        let mut idle_wanted = false;
        loop {
            if sleeps {
                self.make_dark().await?;
                delay = None;
            } else {
                if delay.is_none() {
                    delay = self.delay(&logind).await;
                }
                self.light().await?;
            }
            let mut t_asked = Instant::now();
            sleeps = loop {
                // What was refused may be granted later, as where polkit has only just been started.
                let asks_again = t_asked.elapsed() >= RETRY_AFTER;
                if asks_again {
                    t_asked = Instant::now();
                    if delay.is_none() && !sleeps {
                        delay = self.delay(&logind).await;
                    }
                }
                let may_be_lit = self.may_be_lit.load(Ordering::Relaxed);
                if std::mem::replace(&mut idle_wanted, may_be_lit) != may_be_lit || asks_again && idle.is_none() {
                    idle = if may_be_lit { keep_from_idle_sleep(&logind).await } else { None };
                }
                match tokio::time::timeout(LOOK_EVERY, signals.next()).await {
                    Ok(Some(signal)) => break signal.body().deserialize()?,
                    Ok(None) => return Err(failure("the bus is gone").into()),
                    Err(_) if self.news.is_closed() => return Err(Ended::Run),
                    Err(_) if sleeps && self.is_awake_again() => break false,
                    Err(_) if sleeps && !logind.get_property::<bool>(PREPARING).await? => break false,
                    Err(_) => {}
                }
            };
        }
    }

    /// Waits until the lasers are dark, or the run is over, which ends with dark ones.
    async fn make_dark(&mut self) -> Result<(), Ended> {
        let (may_sleep, dark) = oneshot::channel();
        self.news.send(News::Sleeps(may_sleep)).await?;
        self.dark_since = Some((Instant::now(), slept()));
        let _over = dark.await;
        Ok(())
    }

    /// Whether the machine has slept since the lasers were put out for that, or does not do so in a minute.
    fn is_awake_again(&self) -> bool {
        self.dark_since.is_some_and(|(t, slept_before)| {
            slept().saturating_sub(slept_before) >= Duration::from_secs(1) || t.elapsed() >= SLEEPS_WITHIN
        })
    }

    async fn light(&mut self) -> Result<(), Ended> {
        if self.dark_since.take().is_some() {
            self.news.send(News::Awake).await?;
        }
        Ok(())
    }

    /// While this is held logind waits, for 5 s unless its `InhibitDelayMaxSec` says otherwise, after it has said that
    /// the machine is about to sleep. Where it is refused logind says so all the same, but does not wait.
    async fn delay(&mut self, logind: &Proxy<'_>) -> Option<OwnedFd> {
        match inhibit(logind, "sleep", "lasers go dark before the machine sleeps", "delay").await {
            Ok(delay) => {
                match self.told.replace(true) {
                    Some(false) => {
                        tracing::info!("lasers are put out before the machine sleeps: logind waits for them")
                    }
                    _ => tracing::debug!("logind waits for dark lasers before the machine sleeps"),
                }
                Some(delay)
            }
            Err(error) => {
                self.tell_fault(&error);
                None
            }
        }
    }

    /// Says once that logind does not wait for the lasers.
    fn tell_fault(&mut self, error: &dyn fmt::Display) {
        let told = self.told.replace(false);
        if told == Some(false) {
            return;
        }
        if !self.has_heartbeat {
            tracing::warn!(
                "the lasers have no heartbeat and may stay lit while the machine sleeps: logind cannot be asked to wait \
                 for them ({error}); keep the machine awake while they are lit, as with `systemctl mask sleep.target \
                 suspend.target hibernate.target hybrid-sleep.target`, or put them out before: `holod ctl lasers dark`"
            );
        } else if told == Some(true) {
            tracing::warn!("logind does not wait for dark lasers any more before the machine sleeps: {error}");
        } else {
            tracing::debug!("logind does not wait for dark lasers before the machine sleeps: {error}");
        }
    }
}

fn failure(why: &str) -> zbus::Error {
    zbus::Error::Failure(why.to_owned())
}

/// While this is held logind does not do to an idle machine what its `IdleAction` says.
async fn keep_from_idle_sleep(logind: &Proxy<'_>) -> Option<OwnedFd> {
    let held = inhibit(logind, "idle", "lasers are lit", "block").await;
    held.inspect_err(|error| tracing::debug!("an idle machine may be sent to sleep: {error}")).ok()
}

async fn inhibit(logind: &Proxy<'_>, what: &str, why: &str, mode: &str) -> zbus::Result<OwnedFd> {
    logind.call("Inhibit", &(what, "holod", why, mode)).await
}

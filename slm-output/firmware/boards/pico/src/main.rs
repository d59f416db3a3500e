//! The laser box on a Raspberry Pi Pico.
//!
//! | Pin | |
//! |---|---|
//! | GP2, GP3, GP4 | gates of the red, green and blue laser, high while lit; pull each down with 10 kΩ |
//! | GP6, GP8, GP10 | PWM at 122 kHz for the power of each; low-pass filtered it is the driver's analog input |
//! | GP14 | interlock: connected to ground while closed |
//! | GP15 | the panel's sync output, 3.3 V, rising edge |
//! | USB | the host |
//!
//! `LIMITS` are this box's own: set them to what your lasers and optics make safe, and `FULL_POWER_UW` to what each
//! laser emits at full PWM. Neither wiring nor timing has been tried on a board of ours: measure both before an eye is
//! near.

#![no_std]
#![no_main]

use core::panic::PanicInfo;

use embedded_hal::digital::{InputPin, OutputPin};
use embedded_hal::pwm::SetDutyCycle;
use holod_laser_firmware::{Controller, Hardware, Laser, Limits, TimeUs};
use rp2040_hal::clocks::init_clocks_and_plls;
use rp2040_hal::fugit::ExtU32;
use rp2040_hal::gpio::{DynPinId, FunctionSioInput, FunctionSioOutput, Interrupt, Pin, Pins, PullDown, PullUp};
use rp2040_hal::pwm::Slices;
use rp2040_hal::usb::UsbBus;
use rp2040_hal::{Sio, Timer, Watchdog, pac};
use usb_device::class_prelude::UsbBusAllocator;
use usb_device::device::{StringDescriptors, UsbDevice, UsbDeviceBuilder, UsbDeviceState, UsbVidPid};
use usbd_serial::SerialPort;

/// The second stage of the boot loader, for the flash memory of the board.
#[unsafe(link_section = ".boot2")]
#[used]
static BOOT2: [u8; 256] = rp2040_boot2::BOOT_LOADER_GENERIC_03H;

const CRYSTAL_HZ: u32 = 12_000_000;
/// The box's name: one word.
const NAME: &str = "pico";
/// Its USB serial number, by which a udev rule tells it from another box.
const SERIAL_NUMBER: &str = "1";
/// What this box is built for.
const LIMITS: Limits = Limits {
    power_uw: [1000; 3],
    timeout_us: 250_000,
    lit_us: 20_000,
    // Two turns of the loop, one of which handles a line.
    jitter_us: 300,
    sync_input: true,
};
/// Optical power of each laser at full PWM, microwatts at the panel.
const FULL_POWER_UW: [u32; 3] = [1000; 3];
/// Of the PWM, at 125 MHz: a power is rounded down to one of these.
const POWER_STEPS: u16 = 1024;
/// A loop that stands still for this long resets the board, which makes it dark.
const WATCHDOG_MS: u32 = 20;

type Gate = Pin<DynPinId, FunctionSioOutput, PullDown>;
type Input<P> = Pin<DynPinId, FunctionSioInput, P>;

struct Board<'a, R, G, B> {
    timer: Timer,
    watchdog: Watchdog,
    gates: [Gate; 3],
    powers: (R, G, B),
    interlock: Input<PullUp>,
    sync: Input<PullDown>,
    device: UsbDevice<'a, UsbBus>,
    serial: SerialPort<'a, UsbBus>,
}

impl<R: SetDutyCycle, G: SetDutyCycle, B: SetDutyCycle> Hardware for Board<'_, R, G, B> {
    fn now(&mut self) -> TimeUs {
        TimeUs(self.timer.get_counter().ticks())
    }

    fn sync_edge(&mut self) -> Option<TimeUs> {
        // The edge is latched; its time is that of the turn of the loop that finds it, within LIMITS.jitter_us.
        if !self.sync.interrupt_status(Interrupt::EdgeHigh) {
            return None;
        }
        self.sync.clear_interrupt(Interrupt::EdgeHigh);
        Some(self.now())
    }

    fn interlock_closed(&mut self) -> bool {
        self.interlock.is_low().unwrap_or(false)
    }

    fn host_present(&mut self) -> bool {
        self.device.poll(&mut [&mut self.serial]);
        self.device.state() == UsbDeviceState::Configured && self.serial.dtr()
    }

    fn receive(&mut self, bytes: &mut [u8]) -> usize {
        self.serial.read(bytes).unwrap_or(0)
    }

    fn send(&mut self, line: &[u8]) {
        // What does not fit into the buffer is cut off, and the host takes it for a damaged line.
        let _cut_off = self.serial.write(line);
    }

    fn set_gate(&mut self, lit: Option<Laser>) {
        // Setting a pin of this chip cannot fail.
        for gate in &mut self.gates {
            let _never_fails = gate.set_low();
        }
        if let Some(laser) = lit {
            let _never_fails = self.gates[laser.index()].set_high();
        }
    }

    fn set_power(&mut self, power_uw: [u32; 3]) {
        let duty = |laser: Laser| {
            let full = u64::from(FULL_POWER_UW[laser.index()].max(1));
            (u64::from(power_uw[laser.index()]) * u64::from(POWER_STEPS) / full).min(u64::from(POWER_STEPS)) as u16
        };
        let _never_fails = self.powers.0.set_duty_cycle(duty(Laser::Red));
        let _never_fails = self.powers.1.set_duty_cycle(duty(Laser::Green));
        let _never_fails = self.powers.2.set_duty_cycle(duty(Laser::Blue));
    }

    fn feed_watchdog(&mut self) {
        self.watchdog.feed();
    }
}

#[rp2040_hal::entry]
fn main() -> ! {
    let mut peripherals = pac::Peripherals::take().expect("taken once");
    let sio = Sio::new(peripherals.SIO);
    let pins = Pins::new(peripherals.IO_BANK0, peripherals.PADS_BANK0, sio.gpio_bank0, &mut peripherals.RESETS);
    // Dark before anything else.
    let gates = [
        pins.gpio2.into_push_pull_output().into_pull_type::<PullDown>().into_dyn_pin(),
        pins.gpio3.into_push_pull_output().into_pull_type::<PullDown>().into_dyn_pin(),
        pins.gpio4.into_push_pull_output().into_pull_type::<PullDown>().into_dyn_pin(),
    ];
    let mut watchdog = Watchdog::new(peripherals.WATCHDOG);
    let clocks = init_clocks_and_plls(
        CRYSTAL_HZ,
        peripherals.XOSC,
        peripherals.CLOCKS,
        peripherals.PLL_SYS,
        peripherals.PLL_USB,
        &mut peripherals.RESETS,
        &mut watchdog,
    );
    let Ok(clocks) = clocks else { reset() };
    let timer = Timer::new(peripherals.TIMER, &mut peripherals.RESETS, &clocks);

    let slices = Slices::new(peripherals.PWM, &mut peripherals.RESETS);
    let (mut red, mut green, mut blue) = (slices.pwm3, slices.pwm4, slices.pwm5);
    red.set_top(POWER_STEPS - 1);
    green.set_top(POWER_STEPS - 1);
    blue.set_top(POWER_STEPS - 1);
    red.enable();
    green.enable();
    blue.enable();
    red.channel_a.output_to(pins.gpio6);
    green.channel_a.output_to(pins.gpio8);
    blue.channel_a.output_to(pins.gpio10);

    let bus = UsbBusAllocator::new(UsbBus::new(
        peripherals.USBCTRL_REGS,
        peripherals.USBCTRL_DPRAM,
        clocks.usb_clock,
        true,
        &mut peripherals.RESETS,
    ));
    let serial = SerialPort::new(&bus);
    // The vendor and product of pid.codes for tests; take one of your own before you pass boards on.
    let strings = StringDescriptors::default().manufacturer("holod").product("laser box").serial_number(SERIAL_NUMBER);
    let device = UsbDeviceBuilder::new(&bus, UsbVidPid(0x1209, 0x0001)).device_class(usbd_serial::USB_CLASS_CDC);
    let Ok(device) = device.strings(&[strings]) else { reset() };
    let Ok(device) = device.max_packet_size_0(64) else { reset() };

    let sync = pins.gpio15.into_pull_down_input().into_dyn_pin();
    // Latches edges; without an unmasked interrupt nobody is called for them.
    sync.set_interrupt_enabled(Interrupt::EdgeHigh, true);
    watchdog.start(WATCHDOG_MS.millis());
    let board = Board {
        timer,
        watchdog,
        gates,
        powers: (red.channel_a, green.channel_a, blue.channel_a),
        interlock: pins.gpio14.into_pull_up_input().into_dyn_pin(),
        sync,
        device: device.build(),
        serial,
    };
    let mut controller = Controller::new(board, NAME, LIMITS);
    loop {
        controller.step(&mut |_| ());
    }
}

/// Resets the chip, which makes it dark.
fn reset() -> ! {
    cortex_m::peripheral::SCB::sys_reset()
}

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    reset()
}

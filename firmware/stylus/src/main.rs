//! Firmware of the sensorised stylus: wires the board's interrupts to the logic in
//! `surfaced-stylus-core`.

#![no_std]
#![no_main]

mod board;
#[cfg(feature = "qemu")]
mod recording;

use core::panic::PanicInfo;
use core::sync::atomic::{AtomicU32, Ordering};

use cortex_m_rt::entry;
use stm32f4::stm32f405::interrupt;
use surfaced_stylus_core::{ByteRing, Identity, Sampling, Stylus};

static SAMPLING: Sampling = Sampling::new();
static RECEIVED: ByteRing<256> = ByteRing::new();
static LINE: ByteRing<4096> = ByteRing::new();
/// Number of sampling interrupts; the watchdog is fed only while this number grows.
static TICKS: AtomicU32 = AtomicU32::new(0);

#[interrupt]
fn TIM2() {
    tick();
}

/// Replaces TIM2 under QEMU; see `board::start_timer`.
#[cfg(feature = "qemu")]
#[cortex_m_rt::exception]
fn SysTick() {
    tick();
}

fn tick() {
    let elapsed = board::acknowledge_tick();
    if elapsed > 0 {
        TICKS.fetch_add(1, Ordering::Relaxed);
        SAMPLING.tick(elapsed, board::measure);
    }
}

#[interrupt]
fn USART1() {
    board::serve_uart(&RECEIVED, &LINE);
}

#[entry]
fn main() -> ! {
    let setup = board::init();
    let mut serial = [0; board::SERIAL_LEN];
    let mut stylus = Stylus::new(Identity {
        serial: board::serial(&mut serial),
        firmware: [0, 1, 0],
        sample_rate_hz: board::SAMPLE_RATE_HZ,
        channels: &board::CHANNELS,
        crystal_failed: setup.crystal_failed,
    });
    #[cfg(feature = "qemu")]
    let mut recording = recording::Feed::open();
    let mut ticks = 0;
    loop {
        let idle = stylus.poll(&SAMPLING, &RECEIVED, &LINE);
        #[cfg(feature = "qemu")]
        recording.attend(&mut stylus, idle, &SAMPLING, &LINE);
        board::set_light(stylus.light());
        board::start_sending();
        let now = TICKS.load(Ordering::Relaxed);
        if now != ticks {
            ticks = now;
            board::feed_watchdog();
        }
        if idle {
            // The sampling clock always runs, so this wait ends within one tick.
            cortex_m::asm::wfi();
        }
    }
}

/// A panic cannot be reported. A reset starts the stylus again with a new hello.
#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    cortex_m::peripheral::SCB::sys_reset()
}

//! The hardware: an STM32F405, wired as in `firmware/README.md`. Only this file touches registers.

#[cfg(not(feature = "qemu"))]
use core::sync::atomic::{AtomicU32, Ordering};

use cortex_m::peripheral::NVIC;
use stm32f4::stm32f405::{Interrupt, Peripherals};
use surfaced_stylus_core::ByteRing;
use surfaced_wire::{Channel, STYLUS_CHANNELS};

/// Ticks of the sampling clock per second.
pub const SAMPLE_RATE_HZ: u32 = 10_000;

/// Length of the serial number in hexadecimal digits: 96 bits.
pub const SERIAL_LEN: usize = 24;

/// Frequency of the crystal in MHz; 8 on most boards, 12 or 25 on some.
#[cfg(not(feature = "qemu"))]
const CRYSTAL_MHZ: u8 = 8;

/// Periods of TIM2's clock (twice APB1) per tick.
#[cfg(not(feature = "qemu"))]
const TIMER_PERIOD: u32 = 84_000_000 / SAMPLE_RATE_HZ;

/// The UART's divider: 84 MHz (APB2) / 28 = 3 Mbaud exactly.
const UART_DIVIDER: u32 = 28;

/// Scale of an ADXL335 at 3.3 V in m/s²: 330 mV/g around half the supply, steps of 3.3 V / 65536.
const ACCELERATION: f32 = 9.806_65 * (3.3 / 65_536.0) / 0.330;
/// Scale in V of the channels that start at 0 V.
const VOLTAGE: f32 = 3.3 / 32_768.0;

/// The name, scale and unit of each channel.
pub const CHANNELS: [Channel<'static>; STYLUS_CHANNELS] = [
    Channel { name: "acc_x", scale: ACCELERATION, unit: "m/s²" },
    Channel { name: "acc_y", scale: ACCELERATION, unit: "m/s²" },
    Channel { name: "acc_z", scale: ACCELERATION, unit: "m/s²" },
    Channel { name: "fsr_1", scale: VOLTAGE, unit: "V" },
    Channel { name: "fsr_2", scale: VOLTAGE, unit: "V" },
    Channel { name: "ir", scale: VOLTAGE, unit: "V" },
    // This channel has two values only: 0, and 32767 for 1.
    Channel { name: "metal", scale: 1.0 / 32_767.0, unit: "" },
];

/// The findings of `init`.
pub struct Setup {
    /// The crystal did not start; the internal oscillator, accurate to 1 %, replaces it.
    pub crystal_failed: bool,
}

fn peripherals() -> Peripherals {
    // SAFETY: one core; interrupts and main loop use disjoint registers, except the UART's CR1,
    // where both only ever write the same enable bits and TXEIE, see `start_sending`.
    unsafe { Peripherals::steal() }
}

/// Sets up the hardware; afterwards the sampling clock ticks.
pub fn init() -> Setup {
    let p = peripherals();
    #[cfg(not(feature = "qemu"))]
    let crystal_failed = !start_clocks(&p);
    #[cfg(feature = "qemu")]
    let crystal_failed = false;

    p.RCC.ahb1enr.modify(|_, w| w.gpioaen().set_bit().gpioben().set_bit());
    p.RCC.apb1enr.modify(|_, w| w.tim2en().set_bit().tim5en().set_bit());
    p.RCC.apb2enr.modify(|_, w| w.adc1en().set_bit().usart1en().set_bit());

    // PA0 to PA5 are analogue inputs; PA9 and PA10 belong to the UART (alternate function 7).
    // SAFETY (here and below): the bits are those of the reference manual RM0090.
    p.GPIOA.moder.modify(|r, w| unsafe { w.bits(r.bits() & !0x003C_0000 | 0x0028_0FFF) });
    p.GPIOA.afrh.modify(|r, w| unsafe { w.bits(r.bits() & !0xFF0 | 0x770) });
    p.GPIOA.ospeedr.modify(|r, w| unsafe { w.bits(r.bits() | 0x0008_0000) });
    // PB0 (metal) is an input, pulled down; PB1 (the light) is an output.
    p.GPIOB.moder.modify(|r, w| unsafe { w.bits(r.bits() & !0xF | 0x4) });
    p.GPIOB.pupdr.modify(|r, w| unsafe { w.bits(r.bits() & !0x3 | 0x2) });

    // ADC at 21 MHz with 28 cycles of sampling time: 1.9 µs a channel, 11.4 µs a sample.
    p.ADC_COMMON.ccr.modify(|_, w| w.adcpre().div4());
    p.ADC1.smpr2.write(|w| unsafe { w.bits(0o222_222) });
    p.ADC1.cr2.write(|w| w.adon().set_bit());

    p.USART1.brr.write(|w| unsafe { w.bits(UART_DIVIDER) });
    p.USART1.cr1.write(|w| w.ue().set_bit().te().set_bit().re().set_bit().rxneie().set_bit());

    start_timer(&p);

    // The chip loses a received byte after 3.3 µs, so there the UART goes first. QEMU waits with
    // received bytes, but sends a whole ring in one interrupt, so there the timer goes first.
    let (uart, timer) = if cfg!(feature = "qemu") { (0x80, 0x40) } else { (0x40, 0x80) };
    // SAFETY: no critical section relies on these priorities.
    unsafe {
        let mut core = cortex_m::Peripherals::steal();
        core.NVIC.set_priority(Interrupt::USART1, uart);
        core.NVIC.set_priority(Interrupt::TIM2, timer);
        NVIC::unmask(Interrupt::USART1);
        NVIC::unmask(Interrupt::TIM2);
    }

    // Watchdog: 32 kHz / 32 and 100 counts make about 0.1 s.
    p.IWDG.kr.write(|w| unsafe { w.bits(0x5555) });
    p.IWDG.pr.write(|w| unsafe { w.bits(3) });
    p.IWDG.rlr.write(|w| unsafe { w.bits(100) });
    p.IWDG.kr.write(|w| unsafe { w.bits(0xCCCC) });
    Setup { crystal_failed }
}

/// Sets 168 MHz from the crystal. If it fails, uses the internal oscillator and returns `false`.
#[cfg(not(feature = "qemu"))]
fn start_clocks(p: &Peripherals) -> bool {
    p.RCC.cr.modify(|_, w| w.hseon().set_bit());
    // Crystals start within milliseconds; this waits for tens of milliseconds.
    let crystal = (0..200_000).any(|_| p.RCC.cr.read().hserdy().bit_is_set());
    let (divider, source) = if crystal { (CRYSTAL_MHZ, 1) } else { (16, 0) };
    // 1 MHz × 336 / 2 = 168 MHz; 48 MHz for USB by Q = 7.
    let pll = u32::from(divider) | 336 << 6 | source << 22 | 7 << 24;
    p.RCC.pllcfgr.write(|w| unsafe { w.bits(pll) });
    p.RCC.cr.modify(|_, w| w.pllon().set_bit());
    // 168 MHz need five wait states; prefetch and both caches are on.
    p.FLASH.acr.write(|w| unsafe { w.bits(0x705) });
    while p.RCC.cr.read().pllrdy().bit_is_clear() {}
    // AHB 168, APB1 42, APB2 84 MHz, system clock from the PLL.
    p.RCC.cfgr.write(|w| unsafe { w.bits(0b100 << 13 | 0b101 << 10 | 0b10) });
    while p.RCC.cfgr.read().sws().bits() != 0b10 {}
    crystal
}

/// TIM2 interrupts at each tick. TIM5 counts TIM2's periods, which shows missed ticks.
#[cfg(not(feature = "qemu"))]
fn start_timer(p: &Peripherals) {
    p.TIM2.cr2.write(|w| unsafe { w.bits(0b010 << 4) }); // update event to the trigger output
    p.TIM5.smcr.write(|w| unsafe { w.bits(0b111) }); // clocked by trigger 0, which is TIM2
    p.TIM5.cr1.write(|w| unsafe { w.bits(1) });
    p.TIM2.arr.write(|w| w.bits(TIMER_PERIOD - 1));
    p.TIM2.dier.write(|w| w.uie().set_bit());
    p.TIM2.cr1.write(|w| w.cen().set_bit());
}

/// In QEMU 7.2, TIM2 does not tick periodically: its model sets the next alarm to the time of the
/// last one. So the processor's own timer replaces TIM2.
#[cfg(feature = "qemu")]
fn start_timer(_: &Peripherals) {
    // SAFETY: nothing else uses the processor's timer.
    let mut core = unsafe { cortex_m::Peripherals::steal() };
    core.SYST.set_clock_source(cortex_m::peripheral::syst::SystClkSource::Core);
    core.SYST.set_reload(168_000_000 / SAMPLE_RATE_HZ - 1);
    core.SYST.clear_current();
    core.SYST.enable_interrupt();
    core.SYST.enable_counter();
}

/// The count of TIM5 at the last call.
#[cfg(not(feature = "qemu"))]
static LAST: AtomicU32 = AtomicU32::new(0);

/// Called by the sampling interrupt: returns the number of ticks since the last call.
#[cfg(not(feature = "qemu"))]
pub fn acknowledge_tick() -> u32 {
    let p = peripherals();
    p.TIM2.sr.write(|w| unsafe { w.bits(0) });
    let now = p.TIM5.cnt.read().bits();
    now.wrapping_sub(LAST.swap(now, Ordering::Relaxed))
}

/// The emulated processor may be too slow for real time. A tick then waits until the main loop has
/// kept up, so that the recording's next sample is late, and none is missed.
#[cfg(feature = "qemu")]
pub fn acknowledge_tick() -> u32 {
    u32::from(crate::recording::is_ready())
}

/// Measures all channels; called by the sampling interrupt.
#[cfg(not(feature = "qemu"))]
pub fn measure() -> Option<[i16; STYLUS_CHANNELS]> {
    let p = peripherals();
    let mut values = [0; STYLUS_CHANNELS];
    for (channel, value) in (0u32..6).zip(&mut values) {
        p.ADC1.sqr3.write(|w| unsafe { w.bits(channel) });
        p.ADC1.sr.write(|w| unsafe { w.bits(0) });
        p.ADC1.cr2.modify(|_, w| w.swstart().set_bit());
        // A conversion takes about 320 processor cycles; a faulty converter never ends it.
        (0..1000).find(|_| p.ADC1.sr.read().eoc().bit_is_set())?;
        // The value has twelve bits, so it fits.
        let raw = p.ADC1.dr.read().data().bits() as i16 & 0xFFF;
        // Acceleration swings around half the supply; the other channels start at 0 V.
        *value = if channel < 3 { (raw - 2048) << 4 } else { raw << 3 };
    }
    values[6] = if p.GPIOB.idr.read().bits() & 1 != 0 { i16::MAX } else { 0 };
    Some(values)
}

/// Returns the recording's next sample instead of a measurement.
#[cfg(feature = "qemu")]
pub fn measure() -> Option<[i16; STYLUS_CHANNELS]> {
    crate::recording::next()
}

/// Called by the UART's interrupt: fetches received bytes, and sends bytes while the UART takes them.
pub fn serve_uart<const R: usize, const T: usize>(received: &ByteRing<R>, line: &ByteRing<T>) {
    let uart = &peripherals().USART1;
    while uart.sr.read().rxne().bit_is_set() {
        // Eight data bits. If the ring is full, the byte is lost, and the frame's checksum shows it.
        received.push(&[uart.dr.read().bits() as u8]);
    }
    while uart.sr.read().txe().bit_is_set() {
        let Some(byte) = line.pop() else {
            uart.cr1.modify(|_, w| w.txeie().clear_bit());
            return;
        };
        uart.dr.write(|w| unsafe { w.bits(u32::from(byte)) });
    }
}

/// Makes the UART's interrupt look at the line's ring. The interrupt clears this bit only if it
/// finds the ring empty; if it does so during this call, the bit is still set afterwards.
pub fn start_sending() {
    peripherals().USART1.cr1.modify(|_, w| w.txeie().set_bit());
    // QEMU 7.2's UART has no interrupt for "ready to send".
    #[cfg(feature = "qemu")]
    NVIC::pend(Interrupt::USART1);
}

/// Switches the camera's light.
pub fn set_light(on: bool) {
    let bit = if on { 1 << 1 } else { 1 << 17 };
    peripherals().GPIOB.bsrr.write(|w| unsafe { w.bits(bit) });
}

/// Must be called at least every 0.1 s, or the watchdog resets the chip.
pub fn feed_watchdog() {
    peripherals().IWDG.kr.write(|w| unsafe { w.bits(0xAAAA) });
}

/// The chip's 96-bit serial number in hexadecimal.
#[cfg(not(feature = "qemu"))]
pub fn serial(text: &mut [u8; SERIAL_LEN]) -> &str {
    for (pair, i) in text.as_chunks_mut::<2>().0.iter_mut().zip(0..12usize) {
        // SAFETY: RM0090, 39.1: twelve bytes from this address on can be read.
        let byte = unsafe { core::ptr::read_volatile((0x1FFF_7A10 + i) as *const u8) };
        *pair = [byte >> 4, byte & 15].map(|d| b"0123456789ABCDEF"[usize::from(d)]);
    }
    core::str::from_utf8(text).unwrap_or_default()
}

/// QEMU's chip has no serial number.
#[cfg(feature = "qemu")]
pub fn serial(_: &mut [u8; SERIAL_LEN]) -> &str {
    "QEMU"
}

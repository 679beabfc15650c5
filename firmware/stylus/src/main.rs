#![no_std]
#![no_main]
use cortex_m_rt::entry;
use stm32f4::stm32f405 as _;
#[entry]
fn main() -> ! {
    loop {}
}
#[panic_handler]
fn p(_: &core::panic::PanicInfo) -> ! {
    loop {}
}

//! Hands the linker script to the linker.

fn main() {
    let here = std::env::var("CARGO_MANIFEST_DIR").expect("cargo sets the manifest directory");
    println!("cargo:rustc-link-arg=-T{here}/microbit.ld");
    println!("cargo:rerun-if-changed=microbit.ld");
}

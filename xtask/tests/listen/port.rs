//! Ports of this computer for programs that have to be told one.

use std::net::TcpListener;

/// A port that nobody has, and that the system gives to nobody who asks for any: it takes those from 32768 up, on Linux,
/// or from 49152 up.
pub fn free() -> u16 {
    loop {
        let port = fastrand::u16(20_000..32_000);
        if TcpListener::bind(("127.0.0.1", port)).is_ok() {
            return port;
        }
    }
}

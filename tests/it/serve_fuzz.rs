//! Any request: no panic, and nothing is ordered that is not allowed. tests/fuzz searches for more.

use proptest::prelude::*;

#[path = "../fuzz/requests.rs"]
mod requests;

#[test]
fn the_seeds_of_the_fuzz_target_are_requests() {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fuzz/seeds");
    let mut count = 0;
    for seed in std::fs::read_dir(folder).unwrap() {
        let bytes = std::fs::read(seed.unwrap().path()).unwrap();
        assert!(requests::request(&bytes).is_some(), "{}", String::from_utf8_lossy(&bytes));
        requests::send(&bytes);
        count += 1;
    }
    assert!(count > 0);
}

const PATHS: &str = "(/api/v1/(state|me|audit|scans|scans/correct|scans/[0-9a-z%./-]{0,12}|library|events|start|stop|\
                     reload|enroll|enroll/end)|/metrics|/healthz|/|/page.js|/[!-~]{0,12})\
                     (\\?(limit|before|types|token)=[!-~]{0,20}(&[a-z=%0-9]{0,9})?)?";
const HEADERS: &str = "((host: (localhost|127.0.0.1:80|[!-~]{0,9})\
                       |origin: (null|http://localhost|[!-~]{0,9})\
                       |x-surfaced-person: [!-~]{0,9}|cookie: (a=b; )?surfaced_token=(0123456789abcdef|[!-~]{0,9})\
                       |authorization: (bearer|basic) (0123456789abcdef|[!-~]{0,9})\
                       |sec-fetch-site: (same-origin|cross-site)|content-type: [!-~]{0,9})\n){0,5}";
const BODIES: &str = "\\{\"surface\": \"([a-zé .]{0,9}|[./\\\\<>\\PC]{0,9})\"\
                      (, \"user\": (\"\\PC{0,9}\"|null|7))?(, \"trials\": (-?[0-9]{1,9}))?\\}\
                      |\\PC{0,40}";

proptest! {
    #[test]
    fn no_bytes_are_a_request_that_breaks_anything(
        bytes in proptest::collection::vec(any::<u8>(), 0..200),
    ) {
        requests::send(&bytes);
    }

    #[test]
    fn no_request_breaks_anything_or_orders_what_it_may_not(
        method in "(GET|HEAD|POST|PUT|DELETE|OPTIONS)",
        path in PATHS,
        headers in HEADERS,
        body in BODIES,
    ) {
        requests::send(format!("{method} {path}\n{headers}\n{body}").as_bytes());
    }
}

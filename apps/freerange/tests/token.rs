//! The access token of `freerange serve`: where it comes from, and who gets to see it.

use std::{
    fs,
    io::{BufRead, BufReader, Read, Write},
    net::{TcpListener, TcpStream},
    process::{Child, Command, Stdio},
};

const TOKEN: &str = "correct-horse-battery";

fn serve() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_freerange"));
    command.args(["serve", "--port", "0", "--device", "cpu"]).env_remove("FREERANGE_TOKEN");
    command
}

/// A server that ends with the test, and the line that it printed.
struct Server(Child, String);

impl Drop for Server {
    fn drop(&mut self) {
        self.0.kill().ok();
        self.0.wait().ok();
    }
}

impl Server {
    fn start(command: &mut Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        Self(child, line.trim().to_owned())
    }

    fn status(&self, token: &str) -> u16 {
        let address = self.1.trim_start_matches("http://").split('/').next().unwrap();
        let mut stream = TcpStream::connect(address).unwrap();
        write!(stream, "GET /server HTTP/1.1\r\nHost: {address}\r\nAuthorization: Bearer {token}\r\n\r\n").unwrap();
        let mut reply = Vec::new();
        stream.read_to_end(&mut reply).unwrap();
        std::str::from_utf8(&reply[9..12]).unwrap().parse().unwrap()
    }
}

/// V3.
#[test]
fn a_token_is_drawn_and_printed_once() {
    let [one, other] = [0, 1].map(|_| Server::start(&mut serve()));
    let token = |server: &Server| server.1.split_once("/?token=").unwrap().1.to_owned();
    assert_eq!(token(&one).len(), 48, "{}", one.1);
    assert_ne!(token(&one), token(&other));
    assert_eq!((one.status(&token(&one)), one.status(&token(&other)), one.status("")), (200, 401, 401));
}

/// The first lines that a server prints.
fn lines(arguments: &[&str], count: usize) -> (Server, Vec<String>) {
    let mut child = serve().args(arguments).stdout(Stdio::piped()).spawn().unwrap();
    let lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let found: Vec<String> = lines.take(count).map(Result::unwrap).collect();
    (Server(child, found[0].clone()), found)
}

#[test]
fn a_link_is_printed_for_each_name() {
    let (server, found) = lines(&["--name", "splats.example", "--name", "other.example"], 3);
    let token = found[0].split_once("/?token=").unwrap().1;
    assert_eq!(found[1..], ["splats", "other"].map(|name| format!("https://{name}.example/?token={token}")));
    assert_eq!(server.status(token), 200);
    // Beyond loopback the name leads here without a proxy.
    let (_server, found) = lines(&["--host", "0.0.0.0", "--name", "splats.example"], 2);
    let (address, token) = found[0].split_once("/?token=").unwrap();
    let port = address.rsplit_once(':').unwrap().1;
    assert_eq!(found[1], format!("http://splats.example:{port}/?token={token}"));
}

/// V7.
#[test]
fn a_token_of_ones_own_is_not_printed() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("token");
    fs::write(&file, format!("{TOKEN}\n")).unwrap();
    // The file counts, whatever the environment says.
    let from_file =
        Server::start(serve().arg("--token-file").arg(&file).env("FREERANGE_TOKEN", "another-horse-battery"));
    let from_environment = Server::start(serve().env("FREERANGE_TOKEN", TOKEN));
    for server in [from_file, from_environment] {
        assert!(!server.1.contains("token"), "{}", server.1);
        assert_eq!((server.status(TOKEN), server.status("another-horse-battery")), (200, 401));
    }
}

/// V7.
#[test]
fn what_is_not_safe_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let short = folder.path().join("short");
    fs::write(&short, "hush-hush").unwrap();
    let short = short.to_str().unwrap();
    let cases: [(&[&str], &str); 5] = [
        (&["--host", "0.0.0.0", "--no-token"], "--no-token"),
        (&["--token-file", short], "16 or more letters"),
        (&["--token-file", "/nowhere/token"], "/nowhere/token"),
        (&["--token-file", short, "--no-token"], "cannot be used with"),
        (&["--token", TOKEN], "unexpected argument"),
    ];
    for (arguments, words) in cases {
        let output = serve().args(arguments).output().unwrap();
        let text = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(2) && text.contains(words), "{arguments:?}: {text}");
        assert!(!text.contains("hush"), "{text}");
    }
}

#[test]
fn a_port_in_use_is_refused_with_a_way_out() {
    let other = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = other.local_addr().unwrap();
    let port = address.port().to_string();
    let mut command = Command::new(env!("CARGO_BIN_EXE_freerange"));
    let output = command.args(["serve", "--port", &port, "--device", "cpu", "--no-token"]).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(
        text.contains(&format!("cannot listen at {address}")) && text.contains("--port 0 takes a free port"),
        "{text}"
    );
}

//! Connections: accepted, bounded, answered.

use std::{
    net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener, TcpStream},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
    thread,
    time::{Duration, Instant},
};

use crate::{
    Engine, Refusal, ServeConfig, ServeError,
    board::Board,
    guard::Guard,
    http::{Patience, Request},
    routes::{Site, refused, serve},
};

/// Stack of the thread of a connection.
const STACK: usize = 512 << 10;
/// Longest wait for connections that are open when the server ends.
const FAREWELL: Duration = Duration::from_secs(2);

/// A server that listens, and serves when it [runs](Server::run).
pub struct Server {
    listener: TcpListener,
    address: SocketAddr,
    site: Arc<Site>,
    ended: Arc<AtomicBool>,
}

/// Ends a [`Server`] from another thread.
#[derive(Clone)]
pub struct Stopper {
    address: SocketAddr,
    board: Arc<Board>,
    ended: Arc<AtomicBool>,
}

impl Stopper {
    /// Ends it: jobs stop at their next step, streams are closed, a temporary folder is taken away.
    pub fn stop(&self) {
        self.ended.store(true, Relaxed);
        self.board.stop();
        // Whoever waits for connections gets one.
        let mut address = self.address;
        if address.ip().is_unspecified() {
            address.set_ip(match address.ip() {
                IpAddr::V4(_) => Ipv4Addr::LOCALHOST.into(),
                IpAddr::V6(_) => Ipv6Addr::LOCALHOST.into(),
            });
        }
        drop(TcpStream::connect_timeout(&address, Duration::from_secs(1)));
    }
}

/// Connections beyond all others, for probes and Prometheus; and how long their heads may take.
const RESERVED: u64 = 8;
const RESERVED_TIME: Duration = Duration::from_secs(1);

/// One of the connections that may be open at a time.
struct Connection {
    site: Arc<Site>,
    /// Whether it is one of those for `/health` and `/metrics` alone.
    reserved: bool,
}

impl Connection {
    fn take(site: &Arc<Site>) -> Option<Self> {
        let before = site.board.metrics.connections.fetch_add(1, Relaxed);
        let most = site.board.limits().connections as u64;
        let place = Self { site: site.clone(), reserved: before >= most };
        (before < most + RESERVED).then_some(place)
    }
}

impl Drop for Connection {
    fn drop(&mut self) {
        self.site.board.metrics.connections.fetch_sub(1, Relaxed);
    }
}

/// Answers the one request of a connection.
fn talk(connection: &Connection, stream: TcpStream) {
    let Connection { site, reserved } = connection;
    let limits = site.board.limits();
    let head = if *reserved { limits.head_time.min(RESERVED_TIME) } else { limits.head_time };
    match Request::read(stream, Patience { head, whole: limits.request_time }) {
        Ok(None) => {}
        Ok(Some(request)) if *reserved && !["/health", "/metrics"].contains(&&*request.path) => {
            turn_away(site, &request.into_stream());
        }
        Ok(Some(request)) => serve(site, request),
        Err((stream, _)) if *reserved => turn_away(site, &stream),
        Err((stream, refusal)) => {
            site.board.metrics.answered(refusal.status);
            refused(&refusal).send(stream, false, limits.answer_time);
        }
    }
}

/// In a moment there may be room.
fn turn_away(site: &Site, stream: &TcpStream) {
    site.board.metrics.turned_away.fetch_add(1, Relaxed);
    // Nobody can make us wait.
    let _ = stream.set_nonblocking(true);
    let text = "HTTP/1.1 503 Service Unavailable\r\nRetry-After: 1\r\nContent-Length: 0\r\nConnection: close\r\n\r\n";
    let _ = std::io::Write::write(&mut &*stream, text.as_bytes());
}

impl Server {
    /// Opens the folder of jobs, and listens.
    ///
    /// # Errors
    /// For settings that would not be safe, a folder that cannot be used or that another server uses, an address that is taken.
    pub fn bind(config: &ServeConfig, engine: Arc<dyn Engine>) -> Result<Self, ServeError> {
        config.check()?;
        let wanted = SocketAddr::new(config.host, config.port);
        let refused = |source| ServeError::Listen { address: wanted.to_string(), source };
        let listener = TcpListener::bind(wanted).map_err(refused)?;
        let address = listener.local_addr().map_err(refused)?;
        let board = Arc::new(Board::open(config.keep.as_deref(), config.limits, engine)?);
        let site = Arc::new(Site { board, guard: Guard::new(config), example: config.example });
        Ok(Self { listener, address, site, ended: Arc::default() })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The page's address.
    pub fn url(&self) -> String {
        format!("http://{}/", self.address)
    }

    /// Something that ends it.
    pub fn stopper(&self) -> Stopper {
        Stopper { address: self.address, board: self.site.board.clone(), ended: self.ended.clone() }
    }

    /// Serves until it is [stopped](Stopper::stop).
    ///
    /// # Errors
    /// If the system gives no threads.
    pub fn run(self) -> std::io::Result<()> {
        let board = &self.site.board;
        let named = |name: &str| thread::Builder::new().name(name.into());
        let (computes, empties, searches) = (board.clone(), board.clone(), board.clone());
        let mut workers = vec![
            named("jobs").spawn(move || computes.compute_all())?,
            named("bin").spawn(move || empties.empty_all())?,
            named("cameras").spawn(move || searches.read_all(true))?,
        ];
        for _ in 0..board.limits().readers.max(1) {
            let reads = board.clone();
            workers.push(named("photos").spawn(move || reads.read_all(false))?);
        }
        for stream in self.listener.incoming() {
            if self.ended.load(Relaxed) {
                break;
            }
            let Ok(stream) = stream else {
                // No descriptors are left, or the client has gone.
                thread::sleep(Duration::from_millis(20));
                continue;
            };
            let _ = stream.set_nodelay(true);
            let Some(connection) = Connection::take(&self.site) else {
                turn_away(&self.site, &stream);
                continue;
            };
            if let Err(e) = named("connection").stack_size(STACK).spawn(move || talk(&connection, stream)) {
                tracing::error!("no thread for a connection: {e}");
            }
        }
        board.stop();
        for worker in workers {
            if worker.join().is_err() {
                tracing::error!("{}", Refusal::own("a worker panicked").text);
            }
        }
        let deadline = Instant::now() + FAREWELL;
        while board.metrics.connections.load(Relaxed) > 0 && Instant::now() < deadline {
            thread::sleep(Duration::from_millis(10));
        }
        board.close();
        Ok(())
    }
}

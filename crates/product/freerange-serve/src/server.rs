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

/// One of the connections that may be open at a time.
struct Connection(Arc<Site>);

impl Connection {
    fn take(site: &Arc<Site>) -> Option<Self> {
        let place = Self(site.clone());
        let before = site.board.metrics.connections.fetch_add(1, Relaxed);
        (before < site.board.limits().connections as u64).then_some(place)
    }
}

impl Drop for Connection {
    fn drop(&mut self) {
        self.0.board.metrics.connections.fetch_sub(1, Relaxed);
    }
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
        let (reads, computes) = (board.clone(), board.clone());
        let named = |name: &str| thread::Builder::new().name(name.into());
        let workers =
            [named("photos").spawn(move || reads.read_all())?, named("jobs").spawn(move || computes.compute_all())?];
        let limits = board.limits();
        let patience = Patience { head: limits.head_time, whole: limits.request_time };
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
            let connection = Connection::take(&self.site);
            let full = connection.is_none();
            if full {
                board.metrics.turned_away.fetch_add(1, Relaxed);
                // In a moment there may be room; nothing is read, so that nobody can make us wait.
                let _ = stream.set_nonblocking(true);
                let text = "HTTP/1.1 503 Service Unavailable\r\nRetry-After: 1\r\nContent-Length: 0\r\nConnection: close\r\n\r\n";
                let _ = std::io::Write::write(&mut &stream, text.as_bytes());
                continue;
            }
            let site = self.site.clone();
            let talk = move || {
                let _connection = connection;
                match Request::read(stream, patience) {
                    Ok(None) => {}
                    Ok(Some(request)) => serve(&site, request),
                    Err((stream, refusal)) => {
                        site.board.metrics.answered(refusal.status);
                        refused(&refusal).send(stream, false);
                    }
                }
            };
            if let Err(e) = named("connection").stack_size(STACK).spawn(talk) {
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

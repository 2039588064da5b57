"""A TCP link that can be cut, so that nothing passes and nobody is told, or made slow."""

from __future__ import annotations

import asyncio
import threading
from collections import Counter

from marl_sched.comms.transport.endpoints import check_endpoint, settle_port

CHUNK = 1 << 16


class Link:
    """Relays connections on an endpoint of loopback to another one, in a thread of its own.

    Attributes:
        endpoint: where it listens.
        delay: seconds by which everything comes later.
        hit: counts chunks that were held back while it was cut (`held`) and that came later (`delayed`).
    """

    def __init__(self, target: str) -> None:
        self.endpoint = settle_port(f"{target.partition('/')[0]}/127.0.0.1:0")
        self.delay, self.hit = 0.0, Counter[str]()
        self._target = check_endpoint("target", target)
        self._loop = asyncio.new_event_loop()
        self._cut = False
        self._whole = asyncio.Event()
        self._stopped = asyncio.Event()
        ready = threading.Event()
        self._thread = threading.Thread(target=lambda: self._loop.run_until_complete(self._serve(ready)), daemon=True)
        self._thread.start()
        ready.wait(10)

    def cut(self) -> None:
        """Let nothing pass."""
        self._cut = True
        self._loop.call_soon_threadsafe(self._whole.clear)

    def mend(self) -> None:
        """Let everything pass again, what was held back first."""
        self._cut = False
        self._loop.call_soon_threadsafe(self._whole.set)

    def close(self) -> None:
        """Close all connections."""
        self._loop.call_soon_threadsafe(self._stopped.set)
        self._thread.join(10)

    async def _serve(self, ready: threading.Event) -> None:
        self._whole.set()
        tasks: set[asyncio.Task[None]] = set()

        def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            task = asyncio.ensure_future(self._relay(reader, writer))
            tasks.add(task)
            task.add_done_callback(tasks.discard)

        host, port = check_endpoint("listen", self.endpoint)
        async with await asyncio.start_server(connected, host, port):
            ready.set()
            await self._stopped.wait()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _relay(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            there, back = await asyncio.open_connection(*self._target)
        except OSError:  # nobody listens there at the moment: neither do we
            writer.close()
            return
        try:
            await asyncio.gather(self._pump(reader, back), self._pump(there, writer))
        except OSError:
            self.hit["broken"] += 1
        finally:
            for end in (back, writer):
                end.close()

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        late: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()

        async def deliver() -> None:
            while True:
                due, chunk = await late.get()
                await asyncio.sleep(max(due - self._loop.time(), 0.0))
                await self._whole.wait()
                writer.write(chunk)
                await writer.drain()
                if not chunk:
                    return

        delivery = asyncio.ensure_future(deliver())
        try:
            while chunk := await reader.read(CHUNK):
                self.hit["held"] += self._cut
                self.hit["delayed"] += self.delay > 0
                late.put_nowait((self._loop.time() + self.delay, chunk))
            late.put_nowait((self._loop.time() + self.delay, b""))
            await delivery
        finally:
            delivery.cancel()
            writer.close()

"""Any network and any clients: executed at most once, answered exactly once."""

from __future__ import annotations

from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from remote.unreliable import World

NAMES = st.sampled_from("ab")


class UnreliableNetwork(RuleBasedStateMachine):
    """Cuts, kills, restarts and leaves; against a naive model.

    The model: the client of each request that must be answered.
    """

    def __init__(self) -> None:
        super().__init__()
        self.world = World()
        self.promised: dict[int, str] = {}
        self.answered: set[int] = set()
        self.next_number = 0
        self.resets: set[int] = set()
        self.held: dict[str, Any] = {}

    @initialize()
    def join(self) -> None:
        self.world.join_all()
        self.look()

    def look(self) -> None:
        for result in self.world.take():
            self.check(result)

    def check(self, result: Any) -> None:
        client = self.world.clients[result.client]
        if result.number is not None:
            assert self.promised.get(result.number) == result.client, "not what was promised"
            assert result.number not in self.answered, "a request was answered twice"
            self.answered.add(result.number)
        held = self.held.get(result.client)
        assert held is None or "client_lost" in held.info, "two results without an answer between"
        self.held[result.client] = result
        if result.error is None:
            assert result.observation[0] == client.identity, "another client's observation"
            if "client_lost" not in result.info:
                assert result.reward == result.observation[2]
                assert not result.truncated
                if result.number is None or result.number in self.resets:
                    assert result.observation[2] == 0, "not the result of a reset"
            else:
                assert result.truncated

    # The trainer

    def outstanding(self, name: str) -> bool:
        return any(
            client == name and number not in self.answered
            for number, client in self.promised.items()
        )

    @rule(name=NAMES, reset=st.booleans())
    def ask(self, name: str, reset: bool) -> None:
        if self.outstanding(name):
            return
        self.next_number += 1
        number = self.next_number
        # The answer may arrive before the call returns.
        self.promised[number] = name
        held = self.held.pop(name, None)
        if reset:
            self.resets.add(number)
        submit = self.world.submit_reset if reset else self.world.submit
        if not submit(name, number):
            del self.promised[number]
            reported = held is None or "client_lost" in held.info
            assert reported or reset, "the loss of the client was not reported"
        self.look()

    # The network

    @rule(name=NAMES)
    def deliver_to_server(self, name: str) -> None:
        client = self.world.clients[name]
        if client.outbox:
            self.world.to_server(client)
            self.look()

    @rule(name=NAMES)
    def deliver_to_client(self, name: str) -> None:
        client = self.world.clients[name]
        if client.inbox and client.todo is None:
            self.world.to_client(client)

    @rule(name=NAMES)
    def work(self, name: str) -> None:
        self.world.clients[name].execute()

    @rule()
    def settle(self) -> None:
        self.world.settle()
        self.look()

    @rule(name=NAMES, what=st.sampled_from(["cut", "kill", "leave", "raise", "heal"]))
    def disturb(self, name: str, what: str) -> None:
        client = self.world.clients[name]
        if what == "cut":
            client.cut()
        elif what == "kill":
            client.kill()
        elif what == "leave":
            client.leave()
        else:
            client.raises = what == "raise"

    @rule(name=NAMES)
    def connect(self, name: str) -> None:
        self.world.clients[name].connect()

    @invariant()
    def nothing_is_malformed(self) -> None:
        assert self.world.server.num_malformed == 0

    def teardown(self) -> None:
        """When the network works again, all requests are answered and all clients serve."""
        for client in self.world.clients.values():
            client.raises = False
        for _ in range(3):
            self.world.join_all()
        self.look()
        assert set(self.promised) == self.answered
        assert set(self.world.server.clients) == {"a", "b"}
        assert all(self.world.serving(name) for name in "ab")


TestUnreliableNetwork = UnreliableNetwork.TestCase
TestUnreliableNetwork.settings = settings(stateful_step_count=60)

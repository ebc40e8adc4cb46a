"""What the dashboard's node hears of a graph, and of itself."""

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from tcbi_contract.messages import STREAM_QOS
from tcbi_contract.names import DIAGNOSTICS
from tcbi_dashboard.dashboard_node import listen
from tcbi_dashboard.live import Live


@pytest.fixture
def live(domain):
    """What a page on the test's domain knows."""
    seen = Live()
    listen(seen)
    yield seen
    seen.close()


@pytest.mark.graph
def test_its_own_health_is_no_sign_of_a_graph(live, peer):
    said = peer.collect(DIAGNOSTICS, DiagnosticArray, STREAM_QOS, publishers=1)
    peer.wait_until(lambda: len(said) >= 3, "the page's health")
    assert live.age_s(DIAGNOSTICS) is None and not live.diagnostics
    publisher = peer.publisher(DIAGNOSTICS, DiagnosticArray, STREAM_QOS)
    peer.node.create_timer(0.1, lambda: publisher.publish(DiagnosticArray(status=[DiagnosticStatus(name="sim_node")])))
    peer.wait_until(lambda: live.age_s(DIAGNOSTICS) is not None, "another's")
    assert list(live.diagnostics) == ["sim_node"]

"""The server of the viewer's page answers requests that name this computer only."""

import http.client
import threading

import pytest

from tacpipe.viewer import session


@pytest.mark.parametrize(("host", "status"), [("evil.example:80", 403), ("localhost:80", 502), ("127.0.0.1:80", 502)])
def test_a_page_of_another_site_gets_nothing(host: str, status: int) -> None:
    server = session._start_server(None, "http://127.0.0.1:9")  # No program answers at this port.
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=10)
        connection.request("GET", "/", headers={"Host": host})
        assert connection.getresponse().status == status
    finally:
        server.shutdown()
        server.server_close()
        thread.join()

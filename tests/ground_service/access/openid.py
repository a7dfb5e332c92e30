"""OpenID provider for tests: real HTTP, real keys and signatures; every value of its tokens can be changed."""

import base64
import hashlib
import json
import secrets
import threading
import time
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, urlencode, urlsplit

from joserfc import jwk, jwt

CLIENT, SECRET = "linna", "s3cret/with+signs"
KEY = jwk.RSAKey.generate_key(2048, {"kid": "1"}, private=True)


class OpenIdProvider:
    """Provider in which every visitor of the sign-in page is `claims`."""

    def __init__(self):
        self.claims = {
            "sub": "u-1", "preferred_username": "ann", "roles": ["linna-operators"], "sid": "s-1",
        }  # fmt: skip
        self.change = lambda claims: claims
        self.algorithm = "RS256"
        self.key = KEY
        self.published = [self.key]
        self.codes = {}
        self.codes_once = True
        self.metadata = {}
        self.requests = []
        self.start()
        self.issuer = f"http://127.0.0.1:{self.port}/realms/ops"

    def start(self):
        """Answer, on the port of before after a stop."""
        self._server = ThreadingHTTPServer(("127.0.0.1", getattr(self, "port", 0)), self._handler())
        self.port = self._server.server_port
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,))
        self._thread.start()

    def stop(self):
        """Answer no more."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def authorise(self, address):
        """Return where the provider sends the browser that opens its sign-in page."""
        query = {name: values[0] for name, values in parse_qs(urlsplit(address).query).items()}
        assert query["response_type"] == "code" and query["client_id"] == CLIENT
        assert "openid" in query["scope"].split() and query["code_challenge_method"] == "S256"
        code = secrets.token_urlsafe(8)
        self.codes[code] = query
        return f"{query['redirect_uri']}?{urlencode({'code': code, 'state': query['state'], 'iss': self.issuer})}"

    def signed(self, claims, key=None):
        """Return a signed token."""
        key = key or self.key
        header = {"alg": self.algorithm, "kid": key.kid}
        return jwt.encode(header, claims, key, algorithms=[self.algorithm])

    def common(self):
        """Return the claims of every token."""
        now = int(time.time())
        return {"iss": self.issuer, "aud": CLIENT, "iat": now, "exp": now + 300}

    def exchange(self, form, login):
        """Answer a request to the token endpoint."""
        expected = base64.b64encode(b"linna:s3cret%2Fwith%2Bsigns").decode()
        if login != f"Basic {expected}":
            return 401, {"error": "invalid_client"}
        code = form.get("code", "")
        query = self.codes.pop(code, None) if self.codes_once else self.codes.get(code)
        verifier = hashlib.sha256(form.get("code_verifier", "").encode()).digest()
        challenge = base64.urlsafe_b64encode(verifier).rstrip(b"=").decode()
        if query is None or query["redirect_uri"] != form.get("redirect_uri") or query["code_challenge"] != challenge:
            return 400, {"error": "invalid_grant"}
        claims = self.change({**self.common(), "nonce": query["nonce"], **self.claims})
        return 200, {"access_token": "a", "token_type": "Bearer", "id_token": self.signed(claims)}

    def _handler(self):
        provider = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                provider.requests.append(self.path)
                if self.path.endswith("/.well-known/openid-configuration"):
                    issuer = provider.issuer
                    self._send(
                        200,
                        {
                            "issuer": issuer, "authorization_endpoint": f"{issuer}/authorise",
                            "token_endpoint": f"{issuer}/token", "jwks_uri": f"{issuer}/keys",
                            "end_session_endpoint": f"{issuer}/end",
                            "authorization_response_iss_parameter_supported": True, **provider.metadata,
                        },
                    )  # fmt: skip
                elif self.path.endswith("/keys"):
                    keys = [one.as_dict(private=False) for one in provider.published]
                    self._send(200, {"keys": keys})
                elif "/authorise?" in self.path:
                    self.send_response(302)
                    self.send_header("Location", provider.authorise(self.path))
                    self.send_header("Content-Length", "0")
                    self.end_headers()
                else:
                    self._send(200, {"page": "of the provider"})

            def do_POST(self):
                provider.requests.append(self.path)
                text = self.rfile.read(int(self.headers["Content-Length"])).decode()
                form = {name: values[0] for name, values in parse_qs(text).items()}
                self._send(*provider.exchange(form, self.headers.get("Authorization")))

            def _send(self, status, body):
                octets = json.dumps(body).encode()
                self.send_response(status)
                self.send_header("Content-Type", "application/json")
                self.send_header("Content-Length", str(len(octets)))
                self.end_headers()
                self.wfile.write(octets)

            def log_message(self, *_): ...

        return Handler


@contextmanager
def running_provider():
    """Yield a provider that answers on a private port."""
    provider = OpenIdProvider()
    try:
        yield provider
    finally:
        provider.stop()

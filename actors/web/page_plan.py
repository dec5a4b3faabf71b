"""Address, visitors and encryption of the operator's page of a run."""

from __future__ import annotations

import msgspec

from rampart.actors.web.access import page_url


class PagePlan(msgspec.Struct, frozen=True):
    """Settings of the operator's page of a run, secrets included.

    Attributes:
        port: TCP port; 0 for no page.
        host: address to bind to.
        token: the one token of the page; "" if it needs none, or if a file lists tokens.
        token_is_new: the token was made for this run, so the operator does not know it yet.
        token_file: path of the list of visitors; "" for none.
        cert: path of the certificate; "" for plain HTTP.
        key: path of the certificate's key.
        unencrypted: other machines may reach it unencrypted.
        secret: key of its cookies; without one its node makes one.
        shown: address or name in its URL; "" for `host`.
        audit_log: path of its audit; "" for none.
        behind: origin under which a reverse proxy serves it; "" without one.
    """

    port: int = 0
    host: str = "127.0.0.1"
    token: str = ""
    token_is_new: bool = False
    token_file: str = ""
    cert: str = ""
    key: str = ""
    unencrypted: bool = False
    secret: str = ""
    shown: str = ""
    audit_log: str = ""
    behind: str = ""

    @property
    def url(self) -> str:
        """URL of the page without a token, "" if there is no page."""
        if self.behind:
            return f"{self.behind}/"
        return page_url(self.shown or self.host, self.port, tls=bool(self.cert)
                        ) if self.port else ""

    @property
    def invitation(self) -> str:
        """URL for the person who has started the run: with the token if it is new."""
        if self.token_is_new:
            return f"{self.url} asks for the token {self.token}"
        return f"{self.url} asks for your token" if self.token or self.token_file else self.url

// The API pages: operations of this service, called with the token of the signed-in user.
import { token } from "./api.js";

function withToken(request) {
  if (token() && !request.headers.Authorization) request.headers.Authorization = `Bearer ${token()}`;
  return request;
}

window.SwaggerUIBundle({
  url: "/api/v1/openapi.json",
  dom_id: "#operations",
  deepLinking: true,
  docExpansion: "list",
  requestInterceptor: withToken,
  syntaxHighlight: { activated: true },
  validatorUrl: null,
});

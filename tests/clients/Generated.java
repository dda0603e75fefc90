// A mesh, an animation and the code of a mesh, by the client that openapi-generator makes: java Generated ADDRESS.

import java.io.File;
import java.math.BigDecimal;
import java.nio.file.Files;
import java.util.List;
import org.openapitools.client.ApiClient;
import org.openapitools.client.api.CodesApi;
import org.openapitools.client.api.InterpolationsApi;
import org.openapitools.client.api.ShapesApi;
import org.openapitools.client.model.Animation;
import org.openapitools.client.model.EncodeAnswer;
import org.openapitools.client.model.MeshRequest;

public class Generated {
    public static void main(String[] arguments) throws Exception {
        ApiClient client = new ApiClient();
        client.updateBaseUri(arguments[0]);
        List<BigDecimal> code = java.util.Collections.nCopies(20, new BigDecimal("0.1"));
        List<BigDecimal> end = java.util.Collections.nCopies(20, BigDecimal.ZERO);
        ShapesApi shapes = new ShapesApi(client);
        InterpolationsApi interpolations = new InterpolationsApi(client);
        File byAddress = shapes.getMesh("figure", code, null, null, null, null, null, null, null, null, null);
        MeshRequest request = new MeshRequest().latent(code);
        File byBody = shapes.postMesh("figure", request, null, null, null, null, null, null, null, null);
        if (Files.mismatch(byAddress.toPath(), byBody.toPath()) != -1) throw new Exception("two meshes of one code");
        Animation path = new Animation().keyframes(List.of(code, end)).frames(3);
        String id = interpolations.createInterpolation("figure", path, null, null).getId();
        File animation = interpolations.getInterpolation(id, null, null, null, null, null, null);
        CodesApi codes = new CodesApi(client);
        EncodeAnswer found = codes.encode("figure", byBody, null, null, null, null, null, null, null, null);
        System.out.println(byBody.length() + " " + animation.length() + " " + found.getLatent());
    }
}
